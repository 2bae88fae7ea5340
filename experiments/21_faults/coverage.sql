select
  method, seed, steps as [training steps],
  printf('%.1f', 100 * avg(coverage_68)) as [in the 68 % interval, %],
  printf('%.1f', 100 * avg(coverage_95)) as [in the 95 % interval, %]
from [experiments/21_faults/coverage.csv] group by method, seed
