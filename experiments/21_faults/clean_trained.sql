select a.method, a.seed, a.steps as [training steps], printf('%.2f', avg(a.psnr)) as [PSNR dB], printf('%.2f', avg(a.psnr_inside)) as [inside the body],
  printf('%.3f', avg(a.ssim)) as SSIM, printf('%+.2f', avg(n.psnr - a.psnr)) as [cross_view minus this, dB],
  printf('%.2f', 2 * stdev(n.psnr - a.psnr) / sqrt(count(n.psnr))) as [+-], sum(n.psnr > a.psnr) || ' of ' || count(*) as [cross_view ahead]
from [experiments/21_faults/clean_trained.csv] a
left join [experiments/21_faults/clean_trained.csv] n on n.[case] = a.[case] and n.seed = a.seed and n.method = 'cross_view' and a.method != 'cross_view'
group by a.method, a.seed
