with rows as (
  select 'clean' as views, method, seed, [case], psnr from [experiments/29_ray_weights/networks.csv] where faults = 'none'
  union all select 'clean', method, seed, [case], psnr from [experiments/21_faults/clean_trained.csv] where method = 'world_unet'
  union all select 'clean', method, seed, [case], psnr from [experiments/29_ray_weights/classical.csv] where faults = 'none' and method != 'robust_48'
  union all select iif(faults = 'none', 'clean', 'corrupted pixels'), method, seed, [case], psnr from [experiments/29_ray_weights/fista_tv.csv]
  union all select 'misaligned', method, seed, [case], psnr from [experiments/21_faults/unaligned.csv] where steps < 1500 and method in ('sirt', 'fista_tv', 'world_unet')
  union all select 'misaligned', method, seed, [case], psnr from [experiments/29_ray_weights/networks.csv] where faults like '%tilt%' and method = 'cross_view'
  union all select 'misaligned, then aligned', method, seed, [case], psnr from [experiments/21_faults/rig_errors_aligned.csv] where method != 'sirt_measured'
  union all select 'misaligned or lost, then aligned', method, seed, [case], psnr from [experiments/21_faults/cases.csv]
    where steps < 1500 and method in ('sirt', 'fista_tv', 'world_unet', 'cross_view')
  union all select 'corrupted pixels', method, seed, [case], psnr from [experiments/29_ray_weights/networks.csv] where faults like '%rod%' and method not like '%earlier loss'
  union all select 'corrupted pixels', method, seed, [case], psnr from [experiments/29_ray_weights/classical.csv] where faults like '%rod%' and method != 'robust_48'
)
select a.views, a.method, iif(a.method in ('sirt', 'fista_tv', 'robust_sirt'), '', count(distinct a.seed)) as seeds, printf('%.1f', avg(a.psnr)) as [PSNR dB],
  printf('%+.1f', avg(a.psnr - s.psnr)) as [over SIRT, dB], printf('%.1f', 2 * stdev(a.psnr - s.psnr) / sqrt(33)) as [+-],
  case when a.method = 'fista_tv' or t.psnr is null then '' else printf('%+.1f', avg(a.psnr - t.psnr)) end as [over FISTA-TV, dB]
from rows a
join (select views, [case], avg(psnr) as psnr from rows where method = 'sirt' group by views, [case]) s on s.views = a.views and s.[case] = a.[case]
left join (select views, [case], avg(psnr) as psnr from rows where method = 'fista_tv' group by views, [case]) t on t.views = a.views and t.[case] = a.[case]
where a.method != 'sirt'
group by a.views, a.method
order by min(case a.views when 'clean' then 0 when 'corrupted pixels' then 4 when 'misaligned' then 1 when 'misaligned, then aligned' then 2 else 3 end), avg(a.psnr) desc
