with seeds as (
  select method, steps, seed, avg(psnr) as psnr, avg(psnr_inside) as psnr_inside, avg(seconds) as seconds
  from [experiments/29_ray_weights/small.csv] group by method, steps, seed order by seed
)
select iif(steps, steps, '') as [training steps], method, printf('%.2f', avg(psnr)) as [PSNR dB], group_concat(printf('%.2f', psnr), ', ') as [each seed],
  printf('%.2f', avg(psnr_inside)) as [inside the body], printf('%.0f', avg(seconds)) as [processor time, s]
from seeds group by steps, method order by steps, avg(psnr) desc
