select
  a.fault, printf('%.2f', avg(a.psnr)) as [cross_view dB], printf('%.2f', avg(b.psnr)) as [world_unet dB],
  printf('%.3f', avg(a.heart_nrmse)) as [NRMSE of the heart, cross_view], printf('%.3f', avg(b.heart_nrmse)) as [NRMSE of the heart, world_unet],
  sum(a.heart_nrmse < b.heart_nrmse) || ' of ' || count(*) as [cross_view ahead in the heart]
from [experiments/22_dcspect/faults.csv] a join [experiments/22_dcspect/faults.csv] b
on a.fault = b.fault and a.seed = b.seed and a.[case] = b.[case]
where a.label = 'cross_view' and b.label = 'world_unet'
group by a.fault order by min(a.rowid)
