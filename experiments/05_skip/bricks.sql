select a.scene,
  printf('%.2f to %.2f', min(a.ms / b.ms) filter (where a.rig = 'cone' and task != 'sirt20'), max(a.ms / b.ms) filter (where a.rig = 'cone' and task != 'sirt20')) as [cone],
  printf('%.2f', max(a.ms / b.ms) filter (where a.rig = 'cone' and task = 'sirt20')) as [cone, hull],
  printf('%.2f to %.2f', min(a.ms / b.ms) filter (where a.rig != 'cone' and task != 'sirt20'), max(a.ms / b.ms) filter (where a.rig != 'cone' and task != 'sirt20')) as [oblique rig],
  printf('%.2f', max(a.ms / b.ms) filter (where a.rig != 'cone' and task = 'sirt20')) as [oblique rig, hull]
from [experiments/05_skip/results.csv] as a join [experiments/05_skip/results.csv] as b using (scene, rig, method, task)
where a.mode = 'box' and b.mode = 'brick' group by a.scene order by min(a.occupancy)
