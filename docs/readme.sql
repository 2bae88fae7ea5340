with cpu as (
  select rtk.forward_ms / own.forward_ms as forward, rtk.adjoint_ms / own.adjoint_ms as adjoint
  from [experiments/01_operators/results.csv] own
  join [experiments/01_operators/results.csv] rtk on rtk.n = own.n and rtk.views = own.views and rtk.part = 'rtk'
  where own.views = 32 and own.part = 'drr' and own.method = 'joseph' and own.backend = 'cpu' and own.options not like '%rays_per_pixel%'
),
gpu as (
  select own.[case], nano.forward_ms / own.forward_ms as forward, nano.adjoint_ms / own.adjoint_ms as adjoint,
    astra.adjoint_ms / own.adjoint_ms as astra, nano.pose_ms / own.pose_ms as pose
  from [experiments/23_gpu/operators.csv] own
  join [experiments/23_gpu/operators.csv] nano on nano.[case] = own.[case] and nano.volumes = 1 and nano.program = 'nanodrr n samples'
  join [experiments/23_gpu/operators.csv] astra on astra.[case] = own.[case] and astra.volumes = 1 and astra.program = 'astra cuda'
  where own.volumes = 1 and own.program = 'mvrecon joseph'
),
measured as (select * from [experiments/21_faults/unaligned.csv]),
aligned as (select * from [experiments/21_faults/rig_errors_aligned.csv]),
patients as (
  select unet.psnr - own.psnr as lead from aligned own join aligned unet on unet.[case] = own.[case]
  where own.method = 'cross_view' and unet.method = 'world_unet'
),
spect as (
  select own.seed, own.steps, avg(own.psnr - unet.psnr) as lead
  from [experiments/22_dcspect/cases.csv] own join [experiments/22_dcspect/cases.csv] unet
  on unet.[case] = own.[case] and unet.seed = own.seed and unet.steps between own.steps and 1.3 * own.steps
  where own.method = 'cross_view' and unet.method = 'world_unet' and own.faults = 'all' and unet.faults = 'all'
  group by own.seed, own.steps
)
select
  (select printf('%.1f to %.1f times (forward) and %.1f to %.1f times (adjoint) as fast as RTK',
    min(forward), max(forward), min(adjoint), max(adjoint)) from cpu),
  (select printf('%.1f and %.1f times as fast as nanodrr with 128 samples per ray; the adjoint is %.1f times as fast as ASTRA''s',
    forward, adjoint, astra) from gpu where [case] = '128:32:128'),
  (select iif(pose < 1, 'At 64^3 voxels, nanodrr''s pose gradient is faster', null) from gpu where [case] = '64:8:96'),
  printf('from %.1f to %.1f dB', (select avg(psnr) from measured where method = 'sirt'), (select avg(psnr) from aligned where method = 'sirt')),
  (select printf('at %.2f pixels (stated: 6.125', [columns aside]) from [experiments/25_measured/axis.csv] where [by] = 'calibrate=[offset_u]'),
  printf('is %.1f dB behind cross-view with camera weights and reweighted SIRT',
    (select avg(psnr) from measured where method = 'cross_view, reweight=12' and seed = 0 and steps = 1000)
    - (select avg(psnr) from measured where method = 'world_unet' and steps = 4400)),
  (select printf('leads by %.2f +- %.2f dB', avg(lead), 2 * stdev(lead) / sqrt(count(lead))) from patients),
  (select printf('leads by %.1f to %.1f dB with 16 pinholes', min(lead), max(lead)) from spect),
  printf('it is %.2f dB behind',
    (select avg(psnr) from [experiments/22_dcspect/cases_80.csv] where method = 'world_unet' and steps = 650)
    - (select avg(psnr) from [experiments/22_dcspect/cases_80.csv] where method = 'cross_view' and steps = 500))
