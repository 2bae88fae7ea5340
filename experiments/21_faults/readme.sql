with scores as (
  select method, psnr, null as unaligned from [experiments/21_faults/rig_errors_aligned.csv]
  where method != 'sirt_measured'
  union all
  select method, null, psnr from [experiments/21_faults/unaligned.csv] where steps < 1500
  union all
  select 'today', null, psnr from [experiments/29_ray_weights/networks.csv]
  where method = 'cross_view' and seed = 0 and faults like '%tilt%'
)
select
  case method
    when 'sirt' then 'SIRT'
    when 'fista_tv' then 'FISTA-TV'
    when 'world_unet' then '3-D U-Net'
    when 'cross_view' then 'Cross-view (camera weights)'
    when 'cross_view, reweight=12' then 'Cross-view (camera weights, reweighted SIRT)'
    when 'today' then 'Cross-view (camera and ray weights, reweighted SIRT; default)'
  end as Method,
  printf('%.1f', avg(unaligned)) as [Views as measured, dB],
  coalesce(printf('%.1f', avg(psnr)), '') as [Aligned views, dB]
from scores
group by scores.method
order by avg(unaligned)
