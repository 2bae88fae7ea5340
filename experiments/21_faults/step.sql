select
  method, parameters, printf('%.2f', seconds) as [seconds a step],
  printf('%.2f', ratio) as [relative to world_unet]
from [experiments/21_faults/step.csv]
