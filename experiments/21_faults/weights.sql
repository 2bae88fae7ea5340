select
  views, printf('%.2f', avg(psnr) filter (where weight = 1)) as [all equal],
  printf('%.2f', avg(psnr) filter (where weight = 0.3)) as [faulty ones 0.3],
  printf('%.2f', avg(psnr) filter (where weight = 0.1)) as [0.1],
  printf('%.2f', avg(psnr) filter (where weight = 0)) as [0]
from [experiments/21_faults/weights.csv] group by views order by views desc
