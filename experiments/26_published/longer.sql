with seeds as (
  select method, rate, seed, avg(psnr) as psnr, avg(psnr_inside) as psnr_inside, avg(seconds) as seconds
  from [experiments/26_published/tuning.csv] where steps = 800 group by method, rate, seed
),
runs as (
  select method, rate, count(*) as seeds, avg(psnr) as psnr, group_concat(printf('%.2f', psnr), ', ') as each, avg(psnr_inside) as psnr_inside,
    avg(seconds) as seconds from seeds group by method, rate
),
best as (select *, row_number() over (partition by method order by psnr desc) as place, count(*) over (partition by method) as rates from runs)
select replace(method, ', narrow', '') as network, rates as [rates tried], printf('%g', rate) as [learning rate], printf('%.2f', psnr) as [PSNR dB],
  iif(seeds > 1, each, '') as [each seed], printf('%.2f', psnr_inside) as [inside the body], printf('%.0f', seconds) as [processor time, s]
from best where place = 1 order by psnr desc
