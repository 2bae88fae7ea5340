with cpu as (
  select rtk.forward_ms / own.forward_ms as forward, rtk.adjoint_ms / own.adjoint_ms as adjoint
  from [experiments/01_operators/results.csv] own
  join [experiments/01_operators/results.csv] rtk on rtk.n = own.n and rtk.views = own.views and rtk.part = 'rtk'
  where own.views = 32 and own.part = 'drr' and own.method = 'joseph' and own.backend = 'cpu' and own.options not like '%rays_per_pixel%'
),
gpu as (
  select own.[case], nano.forward_ms / own.forward_ms as forward, nano.adjoint_ms / own.adjoint_ms as adjoint
  from [experiments/23_gpu/operators.csv] own
  join [experiments/23_gpu/operators.csv] nano on nano.[case] = own.[case] and nano.volumes = 1 and nano.program = 'nanodrr n samples'
  where own.volumes = 1 and own.program = 'mvrecon joseph'
),
measured as (select * from [experiments/21_faults/unaligned.csv]),
aligned as (select * from [experiments/21_faults/rig_errors_aligned.csv]),
today as (select * from [experiments/21_faults/sirt_aligned.csv]),
patients as (
  select unet.psnr - own.psnr as lead from aligned own join aligned unet on unet.[case] = own.[case]
  where own.method = 'cross_view' and unet.method = 'world_unet'
),
spect as (
  select own.psnr - unet.psnr as lead, own.heart_nrmse - unet.heart_nrmse as heart
  from [experiments/22_dcspect/cases_footprints.csv] own join [experiments/22_dcspect/cases_footprints.csv] unet on unet.[case] = own.[case]
  where own.method = 'cross_view' and unet.method = 'world_unet'
),
corrupted as (
  select method, avg(psnr) as psnr from [experiments/29_ray_weights/classical.csv] where faults like '%rod%' group by method
),
longer as (
  select avg(a.psnr - b.psnr) as lead from [experiments/29_ray_weights/aligned.csv] a join [experiments/29_ray_weights/aligned.csv] b on b.[case] = a.[case] and b.seed = a.seed where a.method = 'cross_view from robust_sirt, narrow' and b.method = 'world_unet from robust_sirt, narrow' group by a.[case] having count(*) = 3
),
equal as (
  select avg(a.psnr - b.psnr) as lead from [experiments/29_ray_weights/aligned.csv] a join [experiments/29_ray_weights/equal_time_aligned.csv] b on b.[case] = a.[case] and b.seed = a.seed where a.method = 'cross_view from robust_sirt, narrow' group by a.[case] having count(*) = 3
),
starts as (
  select views, avg(seconds) as seconds, count(*) as count, sum(degrees < 1 and mm < 1) as found
  from [experiments/31_registration/starts.csv] where part = 'mvrecon' group by views
)
select
  (select printf('%.1f to %.1f times (forward) and %.1f to %.1f times (adjoint) as fast as RTK',
    min(forward), max(forward), min(adjoint), max(adjoint)) from cpu),
  (select printf('%.1f and %.1f times as fast as nanodrr with 128 samples per ray', forward, adjoint) from gpu where [case] = '128:32:128'),
  (select printf('`robust_sirt` is %.1f dB ahead of SIRT', (select psnr from corrupted where method = 'robust_sirt') - psnr)
    from corrupted where method = 'sirt'),
  (select printf('in %d of %d starts, within 1 to 2 s', found, count) from starts where views = 1 and seconds between 1 and 2),
  printf('from %.1f to %.1f dB', (select avg(psnr) from today where method = 'sirt'), (select avg(psnr) from today where method = 'aligned_sirt')),
  (select printf('at %.2f pixels (its authors: 6.125', [columns aside]) from [experiments/25_measured/axis.csv] where [by] = 'calibrate=[offset_u]'),
  printf('is %.1f dB behind cross-view with camera weights and reweighted SIRT',
    (select avg(psnr) from measured where method = 'cross_view, reweight=12' and seed = 0 and steps = 1000)
    - (select avg(psnr) from measured where method = 'world_unet' and steps = 4400)),
  (select printf('cross-view leads by %.1f +- %.1f dB (three seeds', avg(lead), 2 * stdev(lead) / sqrt(count(lead))) from longer),
  (select printf('%.1f +- %.1f dB at equal time', avg(lead), 2 * stdev(lead) / sqrt(count(lead))) from equal having count(*) = 33),
  (select printf('leads by %.2f +- %.2f dB', avg(lead), 2 * stdev(lead) / sqrt(count(lead))) from patients),
  (select printf('cross-view %+.2f +- %.2f dB, but a larger error in the heart', avg(lead), 2 * stdev(lead) / sqrt(count(lead)))
    from spect having avg(heart) > 0)
