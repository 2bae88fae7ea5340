select iif(a.version is null, 'footprints', 'before footprints') as projector, a.method, a.operator, printf('%.0f', avg(a.held_out)) as [log-likelihood],
  printf('%+.0f', avg(a.held_out - b.held_out)) as [over the earlier blur], printf('%.0f', stdev(a.held_out - b.held_out)) as [standard deviation],
  printf('%+.0f', min(a.held_out - b.held_out)) as least, printf('%d', min(a.iteration)) || iif(min(a.iteration) = max(a.iteration), '', printf(' to %d', max(a.iteration))) as [best iteration]
from [experiments/28_montecarlo/held_out.csv] a join [experiments/28_montecarlo/held_out.csv] b on a.seed = b.seed
where b.version = '8c87dee2' and b.operator = 'hole'
group by a.version, a.method, a.operator
order by a.version is null, instr('osem bsrem mlem kem', a.method), avg(a.held_out)
