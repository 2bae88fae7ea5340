with pairs as (
  select b.method, b.seed, b.steps, avg(a.psnr - b.psnr) as difference,
    2 * stdev(a.psnr - b.psnr) / sqrt(count(*)) as error,
    sum(a.psnr > b.psnr) || ' of ' || count(*) as ahead
  from [experiments/21_faults/unaligned.csv] a join [experiments/21_faults/unaligned.csv] b
  on a.seed = b.seed and a.[case] = b.[case] and b.steps between a.steps and 1.1 * a.steps
  where a.method like '%reweight%' and b.method not like '%reweight%' group by b.method, b.seed, b.steps
)
select
  m.method, m.seed, m.steps as [training steps], printf('%.2f', avg(psnr)) as [PSNR dB],
  printf('%.3f', avg(ssim)) as SSIM,
  printf('%.3f', avg(auc)) as [area under the ROC curve, faulty cameras],
  printf('%+.2f', p.difference) as [first minus this, dB], printf('%.2f', p.error) as [+-],
  p.ahead as [first ahead]
from [experiments/21_faults/unaligned.csv] m
left join pairs p on p.method = m.method and p.seed = m.seed and p.steps = m.steps
group by m.method, m.seed, m.steps
order by m.steps = 0, m.seed, m.steps / 1000, m.method not like '%reweight%', m.method
