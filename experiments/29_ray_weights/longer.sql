with seeds as (
  select method, seed, avg(psnr) as psnr, avg(psnr_inside) as psnr_inside, avg(seconds) as seconds
  from [experiments/29_ray_weights/longer.csv] group by method, seed order by seed
)
select replace(method, ', narrow', '') as method, printf('%.2f', avg(psnr)) as [PSNR dB], group_concat(printf('%.2f', psnr), ', ') as [each seed], printf('%.2f', avg(psnr_inside)) as [inside the body],
  printf('%.0f', avg(seconds) / 60) as [processor time, min]
from seeds group by seeds.method order by avg(psnr) desc
