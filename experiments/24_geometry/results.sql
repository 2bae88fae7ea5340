select steps as [training steps], method || iif(arc = 180, '', ', assumed arc of ' || printf('%g', arc) || ' degrees') as network,
  printf('%.2f', avg(psnr) filter (where patients = 10)) as [10 patients, PSNR dB], printf('%.2f', avg(psnr) filter (where patients = 40)) as [40],
  printf('%.2f', avg(psnr) filter (where patients = 170)) as [170], printf('%.2f', avg(psnr_inside) filter (where patients = 170)) as [170, inside the body]
from [experiments/24_geometry/results.csv] group by steps, method, arc order by steps, avg(psnr) filter (where patients = 170) desc
