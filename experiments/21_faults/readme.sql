with scores as (
  select method, psnr, null as unaligned from [experiments/21_faults/rig_errors_aligned.csv]
  where method != 'sirt_measured'
  union all
  select replace(method, ', reweight=12', ''), null, psnr from [experiments/21_faults/unaligned.csv]
  where steps < 1500 and method != 'cross_view'
)
select
  case method
    when 'sirt' then 'SIRT'
    when 'fista_tv' then 'FISTA-TV'
    when 'world_unet' then '3-D U-Net'
    when 'cross_view' then 'cross-view'
  end as method,
  printf('%.1f', avg(unaligned)) as [dB, views as measured],
  printf('%.1f', avg(psnr)) as [dB, aligned views]
from scores
group by scores.method
order by avg(unaligned)
