with rows as (
  select method, iif(steps < 1500, 1, 2) as length, steps, seconds, [case], psnr, psnr_inside, ssim from (
    select method, steps, seconds, [case], psnr, psnr_inside, ssim from [experiments/29_ray_weights/networks.csv]
    where seed = 0 and method in ('cross_view from robust_sirt', 'world_unet from robust_sirt')
    union all
    select method, steps, seconds, [case], psnr, psnr_inside, ssim from [experiments/29_ray_weights/lengths.csv]
  )
)
select a.method, a.steps as [training steps], printf('%.2f', avg(a.psnr)) as [PSNR dB], printf('%.2f', avg(a.psnr_inside)) as [inside the body],
  printf('%.3f', avg(a.ssim)) as SSIM, printf('%+.2f', avg(n.psnr - a.psnr)) as [cross_view minus this, dB],
  printf('%.2f', 2 * stdev(n.psnr - a.psnr) / sqrt(count(n.psnr))) as [+-], sum(n.psnr > a.psnr) || ' of ' || count(n.psnr) as [cross_view ahead]
from rows a
left join rows n on n.[case] = a.[case] and n.length = a.length and n.method like 'cross_view%' and a.method not like 'cross_view%'
group by a.length, a.method order by a.length, avg(a.psnr) desc
