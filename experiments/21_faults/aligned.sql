with pairs as (
  select b.method, b.seed, b.steps, avg(a.psnr - b.psnr) as difference,
    2 * stdev(a.psnr - b.psnr) / sqrt(count(*)) as error,
    sum(a.psnr > b.psnr) || ' of ' || count(*) as ahead
  from [experiments/21_faults/cases.csv] a join [experiments/21_faults/cases.csv] b
  on a.seed = b.seed and a.[case] = b.[case] and 10 * b.steps = 11 * a.steps
  where a.method = 'cross_view' and b.method = 'world_unet' group by b.seed, b.steps
)
select
  m.method, m.seed, m.steps as [training steps], printf('%.2f', avg(psnr)) as [PSNR dB],
  printf('%.3f', avg(ssim)) as SSIM,
  printf('%.2f', avg(psnr) filter (where lost > 0)) as [dB, one view lost],
  printf('%.2f', avg(psnr) filter (where lost = 0)) as [dB, no view lost],
  printf('%+.2f', p.difference) as [cross_view minus this, dB], printf('%.2f', p.error) as [+-],
  p.ahead as [cross_view ahead]
from [experiments/21_faults/cases.csv] m
left join pairs p on p.method = m.method and p.seed = m.seed and p.steps = m.steps
where m.method != 'sirt_measured'
group by m.method, m.seed, m.steps
order by m.steps = 0, m.steps >= 2000, m.seed, m.method like '%reweight%', m.steps, m.method
