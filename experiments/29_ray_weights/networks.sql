with rows as (
  select method, faults, [case], psnr, psnr_inside, ssim, steps from [experiments/29_ray_weights/networks.csv]
  union all
  select method || ', study 21', 'none', [case], psnr, psnr_inside, ssim, steps from [experiments/21_faults/clean_trained.csv] where method != 'cross_view, per_view_gain=0'
  union all
  select method || ', study 21', faults, [case], psnr, psnr_inside, ssim, steps from [experiments/21_faults/unaligned.csv] where seed = 0 and steps between 1000 and 1100
),
named as (
  select *, case when faults = 'none' then 'clean' when faults like '%rod%' then 'inconsistent' else 'rig errors' end as views from rows
)
select a.views, a.method, a.steps as [training steps], printf('%.2f', avg(a.psnr)) as [PSNR dB], printf('%.2f', avg(a.psnr_inside)) as [inside the body],
  printf('%.3f', avg(a.ssim)) as SSIM, printf('%+.2f', avg(n.psnr - a.psnr)) as [cross_view minus this, dB],
  printf('%.2f', 2 * stdev(n.psnr - a.psnr) / sqrt(count(n.psnr))) as [+-], sum(n.psnr > a.psnr) || ' of ' || count(n.psnr) as [cross_view ahead]
from named a
left join named n on n.[case] = a.[case] and n.views = a.views and n.method = 'cross_view' and a.method != 'cross_view'
group by a.views, a.method having a.views in (select views from named where method = 'cross_view')
order by a.views, avg(a.psnr) desc
