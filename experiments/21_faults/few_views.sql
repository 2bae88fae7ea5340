select a.method, a.steps as [training steps], printf('%.2f', avg(a.psnr)) as [PSNR dB], printf('%.3f', avg(a.ssim)) as SSIM,
  printf('%+.2f', avg(n.psnr - a.psnr)) as [cross_view minus this, dB],
  printf('%.2f', 2 * stdev(n.psnr - a.psnr) / sqrt(count(n.psnr))) as [+-], sum(n.psnr > a.psnr) || ' of ' || count(n.psnr) as [cross_view ahead]
from [experiments/21_faults/few_views.csv] a
left join [experiments/21_faults/few_views.csv] n on n.[case] = a.[case] and n.method = 'cross_view' and a.method != 'cross_view'
group by a.method order by avg(a.psnr) desc
