with seeds as (
  select 'misaligned' as views, * from [experiments/29_ray_weights/misaligned.csv]
  union all select 'misaligned, one may be lost; aligned' as views, * from [experiments/29_ray_weights/aligned.csv]
),
means as (
  select views, steps, method, seed, avg(psnr) as psnr, avg(psnr_inside) as psnr_inside, avg(seconds) as seconds from seeds group by views, method, seed order by seed
)
select views, steps as [training steps], replace(method, ', narrow', '') as method, printf('%.2f', avg(psnr)) as [PSNR dB], group_concat(printf('%.2f', psnr), ', ') as [each seed],
  printf('%.2f', avg(psnr_inside)) as [inside the body], printf('%.0f', avg(seconds) / 60) as [processor time, min]
from means group by views, method order by views, avg(psnr) desc
