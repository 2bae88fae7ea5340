with rows as (
  select method, faults, seed, [case], psnr, psnr_inside, ssim, steps from [experiments/29_ray_weights/networks.csv]
  union all
  select method || ', study 21', 'none', seed, [case], psnr, psnr_inside, ssim, steps from [experiments/21_faults/clean_trained.csv] where method != 'cross_view, per_view_gain=0'
  union all
  select method || ', study 21', faults, seed, [case], psnr, psnr_inside, ssim, steps from [experiments/21_faults/unaligned.csv] where seed = 0 and steps between 1000 and 1100
),
named as (
  select *, case when faults = 'none' then 'clean' when faults like '%rod%' then 'corrupted pixels' else 'misaligned' end as views from rows
),
patients as (  -- means over the seeds; differences between networks of the same seed
  select a.views, a.method, a.[case], a.steps, avg(a.psnr) as psnr, avg(a.psnr_inside) as psnr_inside, avg(a.ssim) as ssim, avg(n.psnr - a.psnr) as difference
  from named a
  left join named n on n.[case] = a.[case] and n.views = a.views and n.seed = a.seed and n.method = 'cross_view' and a.method != 'cross_view'
  group by a.views, a.method, a.[case]
),
seeds as (
  select views, method, group_concat(printf('%.2f', psnr), ', ') as each
  from (select views, method, seed, avg(psnr) as psnr from named group by views, method, seed order by seed) group by views, method
)
select p.views, p.method, p.steps as [training steps], printf('%.2f', avg(p.psnr)) as [PSNR dB], s.each as [each seed], printf('%.2f', avg(p.psnr_inside)) as [inside the body],
  printf('%.3f', avg(p.ssim)) as SSIM, printf('%+.2f', avg(p.difference)) as [cross_view minus this, dB],
  printf('%.2f', 2 * stdev(p.difference) / sqrt(count(p.difference))) as [+-], sum(p.difference > 0) || ' of ' || count(p.difference) as [cross_view ahead]
from patients p join seeds s on s.views = p.views and s.method = p.method
group by p.views, p.method having p.views in (select views from named where method = 'cross_view')
order by p.views, avg(p.psnr) desc
