select
  case a.faults when 'all' then 'faulty' else 'correct' end as cameras,
  b.method as [cross_view minus], a.seed, a.steps as [training steps], printf('%+.2f', avg(a.psnr - b.psnr)) as [PSNR dB],
  printf('%.2f', 2 * stdev(a.psnr - b.psnr) / sqrt(count(*))) as [+-],
  sum(a.psnr > b.psnr) || ' of ' || count(*) as [ahead],
  printf('%+.3f', avg(a.heart_nrmse - b.heart_nrmse)) as [NRMSE, heart],
  printf('%.3f', 2 * stdev(a.heart_nrmse - b.heart_nrmse) / sqrt(count(*))) as [+- ],
  sum(a.heart_nrmse < b.heart_nrmse) || ' of ' || count(*) as [ahead in the heart]
from [experiments/22_dcspect/cases.csv] a join [experiments/22_dcspect/cases.csv] b
on a.faults = b.faults and a.[case] = b.[case]
  and (b.steps = 0 or a.seed = b.seed and b.steps > a.steps and b.steps < 1.3 * a.steps)
where a.method = 'cross_view' and b.method in ('world_unet', 'bsrem')
group by a.faults, b.method, a.seed, a.steps
order by a.faults, b.method desc, a.steps, a.seed
