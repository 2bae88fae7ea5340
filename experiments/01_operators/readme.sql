select
  case part
    when 'drr' then 'mvrecon `' || method || '`'
    when 'rtk' then 'RTK 2.7 Joseph (C++)'
    when 'nanodrr' then 'nanodrr 0.1.7 trilinear'
    when 'diffdrr' then 'DiffDRR 0.6.1 Siddon'
  end as projector,
  printf('%.0f', forward_ms) as [forward ms],
  printf('%.0f', adjoint_ms) as [adjoint ms],
  printf('%.4f', error_thin) as error
from [experiments/01_operators/sizes/results.csv]
where status = 'ok' and n = 128 and part in ('drr', 'rtk', 'nanodrr', 'diffdrr')
  and (part != 'drr' or (method = 'joseph' and backend = 'cpu' and options not like '%rays_per_pixel%'))
order by forward_ms
