select case when a.faults like '%lost%' then 'aligned' else 'as measured' end as views, a.start as [iterations of the start], a.reweight as [reweighted iterations], a.steps as [training steps],
  printf('%.2f', avg(b.psnr)) as [without, PSNR dB], printf('%.2f', avg(a.psnr)) as [with, PSNR dB], printf('%+.2f', avg(a.psnr - b.psnr)) as [difference dB],
  printf('%.2f', 2 * stdev(a.psnr - b.psnr) / sqrt(count(*))) as [+-], sum(a.psnr > b.psnr) || ' of ' || count(*) as ahead
from [experiments/21_faults/reweight.csv] a
join (select faults, method, seed, steps, [case], psnr from [experiments/21_faults/unaligned.csv] union all select faults, method, seed, steps, [case], psnr from [experiments/21_faults/cases.csv]) b
on b.method = 'cross_view' and b.seed = a.seed and b.steps = a.steps and b.[case] = a.[case] and (b.faults like '%lost%') = (a.faults like '%lost%')
group by a.faults, a.start order by views desc, a.start desc
