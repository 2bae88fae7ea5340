with pairs as (
  select b.method, b.voxels, avg(a.psnr - b.psnr) as difference,
    2 * stdev(a.psnr - b.psnr) / sqrt(count(*)) as error,
    sum(a.psnr > b.psnr) || ' of ' || count(*) as ahead
  from [experiments/21_faults/grids.csv] a join [experiments/21_faults/grids.csv] b
  on a.voxels = b.voxels and a.[case] = b.[case]
  where b.method not like '%reweight%' and
    a.method = iif(b.method like '%from 32^3', 'cross_view, reweight=12, from 32^3', 'cross_view, reweight=12')
  group by b.method, b.voxels
)
select
  printf('%d^3', m.voxels) as grid, m.method, steps as [training steps],
  count(*) as patients, printf('%.2f', avg(psnr)) as [PSNR dB],
  printf('%.2f', avg(psnr_inside)) as [inside the body], printf('%.3f', avg(ssim)) as SSIM,
  printf('%+.2f', p.difference) as [cross_view minus this, dB], printf('%.2f', p.error) as [+-],
  p.ahead as [cross_view ahead]
from [experiments/21_faults/grids.csv] m
left join pairs p on p.method = m.method and p.voxels = m.voxels
where m.method not in ('fista_tv, weight 6e-4', 'fista_tv, weight 1.2e-3')
group by m.voxels, m.method
order by m.voxels, avg(psnr_inside) desc
