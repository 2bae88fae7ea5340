select a.method as [change], printf('%.2f', avg(a.psnr)) as [PSNR dB], printf('%.3f', avg(a.ssim)) as SSIM,
  printf('%.3f', avg(a.auc)) as [area under the ROC curve, faulty cameras],
  printf('%+.2f', avg(a.psnr - n.psnr)) as [this minus none, dB],
  printf('%.2f', 2 * stdev(a.psnr - n.psnr) / sqrt(count(n.psnr))) as [+-], sum(a.psnr > n.psnr) || ' of ' || count(n.psnr) as [this ahead]
from [experiments/21_faults/ablations.csv] a
left join [experiments/21_faults/ablations.csv] n on n.[case] = a.[case] and n.method = 'none' and a.method != 'none'
group by a.method order by avg(a.psnr) desc
