select a.method, a.seed, printf('%.2f', avg(a.psnr)) as [PSNR dB], printf('%.2f', avg(a.psnr_inside)) as [inside the body], max(a.seconds) as [processor time, s],
  printf('%+.2f', avg(n.psnr - a.psnr)) as [cross_view minus this, dB], printf('%.2f', 2 * stdev(n.psnr - a.psnr) / sqrt(count(n.psnr))) as [+-],
  sum(n.psnr > a.psnr) || ' of ' || count(n.psnr) as [cross_view ahead]
from [experiments/29_ray_weights/small.csv] a
left join [experiments/29_ray_weights/small.csv] n on n.[case] = a.[case] and n.seed = a.seed and n.method = 'cross_view' and a.method != 'cross_view'
group by a.method, a.seed order by a.seed, avg(a.psnr) desc
