select case a.faults when 'none' then 'clean' else 'corrupted pixels' end as views,
  case a.method when 'robust_48' then 'robust_sirt, iterations=48' when 'sirt' then 'sirt, 25 iterations with momentum' else a.method end as method,
  printf('%.2f', avg(a.psnr)) as [PSNR dB], printf('%.2f', avg(a.psnr_inside)) as [inside the body], printf('%.3f', avg(a.ssim)) as SSIM,
  printf('%+.2f', avg(n.psnr - a.psnr)) as [robust_sirt minus this, dB], printf('%.2f', 2 * stdev(n.psnr - a.psnr) / sqrt(count(n.psnr))) as [+-],
  sum(n.psnr > a.psnr) || ' of ' || count(n.psnr) as [robust_sirt ahead]
from [experiments/29_ray_weights/classical.csv] a
left join [experiments/29_ray_weights/classical.csv] n on n.[case] = a.[case] and n.faults = a.faults and n.method = 'robust_sirt' and a.method != 'robust_sirt'
group by a.faults, a.method order by a.faults = 'none', avg(a.psnr) desc
