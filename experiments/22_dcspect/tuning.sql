with best as (
  select faults, method, iterations, min(loss) as loss, weight
  from [experiments/22_dcspect/tuning.csv] group by faults, method, iterations
)
select
  a.method, a.iterations, printf('%.4f', a.loss) as [correct cameras],
  printf('%g', a.weight) as [weight], printf('%.4f', b.loss) as [faulty cameras],
  printf('%g', b.weight) as [weight ]
from best a join best b on a.method = b.method and a.iterations = b.iterations
where a.faults = 'none' and b.faults = 'all'
order by a.method desc, a.iterations
