select
  case m.faults when 'all' then 'faulty' else 'correct' end as cameras, m.method, m.seed, m.steps as [training steps], printf('%.2f', avg(psnr)) as [PSNR dB],
  printf('%.3f', avg(nrmse)) as NRMSE, printf('%.3f', avg(heart_nrmse)) as [NRMSE, heart],
  printf('%+.0f', 100 * avg(wall_bias)) as [counts of the wall, %],
  printf('%.2f', sqrt(avg(contrast_error * contrast_error))) as [contrast, rms error],
  (
    select printf('%.2f', avg((i.contrast > h.contrast) + 0.5 * (i.contrast = h.contrast)))
    from [experiments/22_dcspect/cases.csv] i join [experiments/22_dcspect/cases.csv] h
    on i.faults = h.faults and i.method = h.method and i.seed is h.seed and i.steps = h.steps
    where i.ill = 1 and h.ill = 0 and i.faults = m.faults and i.method = m.method
      and i.seed is m.seed and i.steps = m.steps
  ) as [AUC, defect], printf('%.2f', avg(auc)) as [AUC, faulty cameras]
from [experiments/22_dcspect/cases.csv] m
group by m.faults, m.method, m.seed, m.steps
order by m.faults, m.steps = 0, m.steps > 400, m.seed, m.steps
