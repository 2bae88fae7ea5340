select
  a.faults as [fault], printf('%.2f', avg(b.psnr)) as [world_unet dB],
  printf('%+.2f', avg(a.psnr - b.psnr)) as [difference dB],
  printf('%.2f', 2 * stdev(a.psnr - b.psnr) / sqrt(count(*))) as [+-],
  sum(a.psnr > b.psnr) || ' of ' || count(*) as [cross_view ahead]
from [experiments/21_faults/faults.csv] a join [experiments/21_faults/faults.csv] b
on a.faults = b.faults and a.[case] = b.[case]
where a.method = 'cross_view' and b.method = 'world_unet'
group by a.faults order by avg(a.psnr - b.psnr) desc
