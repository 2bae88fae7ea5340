with scores as (
  select method, psnr, null as unaligned from [experiments/21_faults/rig_errors_aligned.csv]
  where method != 'sirt_measured'
  union all
  select method, null, psnr from [experiments/21_faults/unaligned.csv]
  where steps < 1500 and method != 'cross_view, reweight=12'
  union all
  select 'today', null, psnr from [experiments/29_ray_weights/networks.csv]
  where method = 'cross_view' and seed = 0 and faults like '%tilt%'
)
select
  case method
    when 'sirt' then 'SIRT'
    when 'fista_tv' then 'FISTA-TV'
    when 'world_unet' then '3-D U-Net'
    when 'cross_view' then 'Cross-view, camera weights alone'
    when 'today' then 'Cross-view (default)'
  end as Method,
  printf('%.1f', avg(unaligned)) as [Misaligned views, dB],
  coalesce(printf('%.1f', avg(psnr)), '') as [After `correct=align`, dB]
from scores
group by scores.method
order by avg(unaligned)
