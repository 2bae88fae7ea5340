with few as (
  select 'misaligned' as views, seed, steps, [case], psnr from [experiments/21_faults/ablations.csv] where method = 'none'
  union all
  select 'misaligned', seed, steps, [case], psnr from [experiments/21_faults/wider.csv] where method = 'default'
  union all
  select 'misaligned, reweight=12', seed, steps, [case], psnr from [experiments/21_faults/unaligned.csv]
  where method = 'cross_view, reweight=12'
  union all
  select 'aligned', seed, steps, [case], psnr from [experiments/21_faults/cases.csv] where method = 'cross_view'
  union all
  select 'counts of 16 pinholes', seed, steps, [case], psnr from [experiments/22_dcspect/cases.csv]
  where method = 'cross_view' and faults = 'all'
), more as (
  select 'misaligned' as views, '[16,32]' as widths, seed, steps, [case], psnr from [experiments/21_faults/ablations.csv]
  where method = 'weight_widths=[16,32]'
  union all
  select case when faults like 'views 4%' then 'counts of 16 pinholes' when faults like '%lost%' then 'aligned'
    when method = 'weights_16_32' then 'misaligned' else 'misaligned, reweight=12' end,
    iif(method like '%[32,64]', '[32,64]', '[16,32]'), seed, steps, [case], psnr
  from [experiments/21_faults/wider.csv] where method != 'default'
)
select m.views, m.seed, m.steps as [training steps], m.widths as weight_widths, printf('%.2f', avg(m.psnr)) as [PSNR dB],
  printf('%.2f', avg(f.psnr)) as [default, dB], printf('%+.2f', avg(m.psnr - f.psnr)) as [wider minus default, dB],
  printf('%.2f', 2 * stdev(m.psnr - f.psnr) / sqrt(count(*))) as [+-], sum(m.psnr > f.psnr) || ' of ' || count(*) as [wider ahead]
from more m join few f on f.views = m.views and f.seed = m.seed and f.steps = m.steps and f.[case] = m.[case]
group by m.views, m.widths, m.seed, m.steps
order by m.views like 'counts%', m.views = 'aligned', m.views, m.widths, m.steps, m.seed
