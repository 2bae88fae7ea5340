select
  case
    when method = 'sirt_measured' then 'SIRT, views as measured'
    when method = 'sirt' then 'SIRT, aligned'
    when method = 'fista_tv' then 'FISTA-TV, aligned'
    when method like 'world_unet%' then '3-D U-Net, aligned'
    when method like 'cross_view%' then 'cross-view, aligned'
  end as method,
  printf('%.1f', avg(psnr)) as [PSNR dB],
  printf('%.2f', avg(ssim)) as SSIM
from [experiments/21_faults/cases.csv] as cases
where seed = 0
group by cases.method
order by avg(psnr)
