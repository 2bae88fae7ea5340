with seeds as (
  select 'corrupted pixels' as views, * from [experiments/29_ray_weights/equal_time_corrupted.csv]
  union all select 'misaligned, one may be lost; aligned', * from [experiments/29_ray_weights/equal_time_aligned.csv]
  union all select 'corrupted pixels', * from [experiments/29_ray_weights/longer.csv] where method in ('cross_view from robust_sirt, narrow', 'world_unet from robust_sirt, narrow')
    and seed in (select seed from [experiments/29_ray_weights/equal_time_corrupted.csv])
  union all select 'misaligned, one may be lost; aligned', * from [experiments/29_ray_weights/aligned.csv] where method in ('cross_view from robust_sirt, narrow', 'world_unet from robust_sirt, narrow')
    and seed in (select seed from [experiments/29_ray_weights/equal_time_aligned.csv])
),
means as (
  select views, method, steps, seed, avg(psnr) as psnr, avg(psnr_inside) as psnr_inside from seeds group by views, method, steps, seed order by seed
)
select views, replace(method, ', narrow', '') as method, steps as [training steps], printf('%.2f', avg(psnr)) as [PSNR dB], group_concat(printf('%.2f', psnr), ', ') as [each seed],
  printf('%.2f', avg(psnr_inside)) as [inside the body]
from means group by views, method, steps order by views, avg(psnr) desc
