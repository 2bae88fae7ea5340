select scene,
  printf('%.1f to %.1f', min(over_crop) filter (where task = 'forward'), max(over_crop) filter (where task = 'forward')) as forward,
  printf('%.1f to %.1f', min(over_crop) filter (where task = 'forward_static'), max(over_crop) filter (where task = 'forward_static')) as forward_static,
  printf('%.1f to %.1f', min(over_crop) filter (where task = 'adjoint'), max(over_crop) filter (where task = 'adjoint')) as adjoint,
  printf('%.1f to %.1f', min(over_crop) filter (where task = 'sirt20'), max(over_crop) filter (where task = 'sirt20')) as sirt20
from [experiments/05_skip/results.csv] where mode = 'auto' group by scene order by min(occupancy)
