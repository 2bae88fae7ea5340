with runs as (
  select replace(method, ', narrow', '') as network, iif(method like '%narrow', 'half', 'full') as width, rate, count(*) as cases, avg(psnr) as psnr,
    avg(psnr_inside) as psnr_inside, avg(seconds) as seconds
  from [experiments/26_published/tuning.csv] where steps = 200 group by method, rate
),
best as (select *, row_number() over (partition by network order by psnr desc) as place, count(*) over (partition by network) as tried from runs)
select network, tried as [rates and widths tried], width, printf('%g', rate) as [learning rate], printf('%.2f', psnr) as [PSNR dB], printf('%.2f', psnr_inside) as [inside the body],
  printf('%.0f', seconds) as [processor time, s]
from best where place = 1 order by psnr desc
