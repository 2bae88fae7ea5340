-- The words with numbers of experiments/README.md, study by study.
with projectors as (  -- study 01
  select rtk.forward_ms / own.forward_ms as forward, rtk.adjoint_ms / own.adjoint_ms as adjoint
  from [experiments/01_operators/results.csv] own
  join [experiments/01_operators/results.csv] rtk on rtk.n = own.n and rtk.views = own.views and rtk.part = 'rtk'
  where own.views = 32 and own.part = 'drr' and own.method = 'joseph' and own.backend = 'cpu' and own.options not like '%rays_per_pixel%'
),
skips as (  -- 05
  select task = 'sirt20' as iterated, over_full from [experiments/05_skip/results.csv] where mode = 'auto' and scene in ('derenzo', 'ventricle')
),
axes as (  -- 08
  select abs([error, px]) as error from [experiments/08_calibration/axis.csv] where kept is null
),
methods as (  -- 11
  select own.ms / rtk.ms as share, 100 * (own.error / rtk.error - 1) as excess from [experiments/11_methods/results.csv] own
  join [experiments/11_methods/results.csv] rtk on rtk.part = own.peer and rtk.views = own.views where own.part in ('fdk', 'cgls', 'os_sart')
),
spheres as (  -- 14
  select method, iteration, max(recovery) as recovery, max(variability) as variability
  from [experiments/14_counts/recovery.csv] where sphere_mm = 10 group by method, iteration
),
quieter as (
  select method, 100 * (1 - variability / (select m.variability from spheres m where m.method = 'mlem' and m.recovery >= s.recovery order by m.iteration limit 1)) as percent
  from spheres s where (method like 'bsrem%' and iteration = 15) or (method like 'tv_map%' and iteration = 100)
),
rigs as (select scene, avg(any_rig - fista_tv) as lead from [experiments/16_any_rig/domains.csv] group by scene),  -- 16
maps as (select mu, avg(nrmse) as nrmse from [experiments/17_spect_ct/results.csv] group by mu),  -- 17
misaligned as (  -- 21
  select own.method, own.seed, own.steps, avg(own.psnr - unet.psnr) as lead
  from [experiments/21_faults/unaligned.csv] own join [experiments/21_faults/unaligned.csv] unet
  on unet.[case] = own.[case] and unet.seed = own.seed and unet.method = 'world_unet' and unet.steps between own.steps and 1.1 * own.steps
  where own.method like 'cross_view%' group by own.method, own.seed, own.steps
),
lost as (
  select avg(own.psnr - unet.psnr) as lead from [experiments/21_faults/faults.csv] own join [experiments/21_faults/faults.csv] unet
  on unet.[case] = own.[case] and unet.faults = own.faults and unet.method = 'world_unet'
  where own.method = 'cross_view' and (own.faults like '%saturated%' or own.faults like '%lost 2%') group by own.faults
),
clean as (
  select avg(unet.psnr - own.psnr) as lead from [experiments/21_faults/clean_trained.csv] own join [experiments/21_faults/clean_trained.csv] unet
  on unet.[case] = own.[case] and unet.method = 'world_unet' where own.method = 'cross_view'
),
gpu as (  -- 23
  select nano.forward_ms / own.forward_ms as forward, nano.adjoint_ms / own.adjoint_ms as adjoint, astra.adjoint_ms / own.adjoint_ms as astra
  from [experiments/23_gpu/operators.csv] own
  join [experiments/23_gpu/operators.csv] nano on nano.[case] = own.[case] and nano.volumes = 1 and nano.program = 'nanodrr n samples'
  join [experiments/23_gpu/operators.csv] astra on astra.[case] = own.[case] and astra.volumes = 1 and astra.program = 'astra cuda'
  where own.volumes = 1 and own.program = 'mvrecon joseph' and own.[case] = '128:32:128'
),
differences as (select method, max([forward off], [forward auto], [forward box], [adjoint off], [adjoint auto], [adjoint box]) as largest from [experiments/23_gpu/check.csv]),
counts as (  -- 28
  select coalesce(version, 'now') as version, operator, seed, max(held_out) as held_out
  from [experiments/28_montecarlo/held_out.csv] where method = 'osem' and operator = 'hole' group by 1, 2, 3
),
ahead as (select now.held_out - earlier.held_out as lead from counts now join counts earlier on earlier.seed = now.seed and earlier.version != 'now' where now.version = 'now'),
robust as (  -- 29
  select avg(own.psnr - sirt.psnr) as lead from [experiments/29_ray_weights/classical.csv] own join [experiments/29_ray_weights/classical.csv] sirt
  on sirt.[case] = own.[case] and sirt.faults = own.faults and sirt.method = 'sirt' where own.method = 'robust_sirt' and own.faults like '%rod%'
),
networks as (
  select own.method, avg(own.psnr - unet.psnr) as lead, count(distinct own.seed) as seeds
  from [experiments/29_ray_weights/networks.csv] own join [experiments/29_ray_weights/networks.csv] unet
  on unet.[case] = own.[case] and unet.seed = own.seed and unet.faults = own.faults and unet.method = replace(own.method, 'cross_view', 'world_unet')
  where own.faults like '%rod%' group by own.method
),
checks as (select kind, wide, said = 'nothing' as silent, said = 'named' as named from [experiments/30_scan_effects/checks.csv]),  -- 30
descents as (  -- 31
  select part, views, avg(seconds) as seconds, count(*) as starts, sum(degrees < 1 and mm < 1) as found from [experiments/31_registration/starts.csv] group by part, views
)
select printf('forward %.1f to %.1f, adjoint %.1f to %.1f times as fast as RTK in C++', min(forward), max(forward), min(adjoint), max(adjoint)) from projectors
union all select printf('projections are %.1f to %.1f times as fast', min(over_full), max(over_full)) from skips where not iterated
union all select printf('SIRT %.1f to %.1f times', min(over_full), max(over_full)) from skips where iterated
union all select printf('bfloat16 adds %.2f %% to a view', 100 * max(error)) from [experiments/06_precision/results.csv] where precision = 'bfloat16 stored' and task like '% forward'
union all select printf('saves at most %.0f %% of the time', 100 * (1 - min(ratio))) from [experiments/06_precision/results.csv] where precision like '%16 stored'
union all select printf('from an error of %.3f to %.3f', max(error) filter (where [true matrices in] = 'ideal'), max(error) filter (where [true matrices in] = 'back-projection'))
  from [experiments/07_misalignment/results.csv] where misalignment = 'all three'
union all select printf('Offsets and shifts to %.2f pixels, tilts to %.2f degrees', max(error) filter (where unit = 'px'), max(error) filter (where unit = 'degrees'))
  from [experiments/08_calibration/results.csv]
union all select printf('the axis of noisy views to %.2f pixels', max(error)) from axes
union all select printf('need %.2f to %.2f of RTK''s time, at errors at most %.0f %% larger', min(share), max(share), max(excess)) from methods
union all select printf('BSREM of weight 0.003 has %.0f %% less noise', percent) from quieter where method = 'bsrem 0.003'
union all select printf('of 0.03 %.0f %%', percent) from quieter where method = 'bsrem 0.03'
union all select printf('total variation %.0f %%', percent) from quieter where method like 'tv_map%'
union all select printf('to %.1f %%', 100 * max(abs(measured / expected - 1))) from [experiments/15_spect_figures/numbers.csv]
union all select printf('%.1f dB ahead of the best FISTA-TV', lead) from rigs where scene = 'patients'
union all select printf('%.1f dB with three misaligned views', lead) from rigs where scene = 'patients, 3 wrong views'
union all select printf('%.1f dB behind for ellipsoids', -lead) from rigs where scene = 'ellipsoids'
union all select printf('NRMSE %.3f, with the true map %.3f', (select nrmse from maps where mu = 'estimated'), (select nrmse from maps where mu = 'true'))
union all select printf('%.3f if it is shifted by 10 mm', nrmse) from maps where mu like '%shifted'
union all select printf('contrast of %.2f, in truth %.2f', avg(defect_contrast) filter (where method = 'osem, no attenuation'), avg(defect_contrast) filter (where method = 'truth'))
  from [experiments/19_spect_defect/results.csv]
union all select printf('%.0f %% of the wall''s counts are missing', -100 * avg(wall_bias)) from [experiments/19_spect_defect/results.csv] where method = 'osem, no attenuation'
union all select printf('`cross_view`, %.1f to %.1f dB ahead of `world_unet`', min(lead), max(lead)) from misaligned where method like '%reweight%'
union all select printf('%.1f to %.1f dB where several are lost or overexposed', min(lead), max(lead)) from lost
union all select printf('`world_unet` is %.1f dB ahead', lead) from clean
union all select printf('at 128^3, forward is %.1f and adjoint %.1f times as fast as nanodrr', forward, adjoint) from gpu
union all select printf('adjoint is %.1f times as fast as ASTRA''s', astra) from gpu
union all select printf('to %.0e of the largest value, `siddon` to %.0e', max(largest) filter (where method != 'siddon'), max(largest) filter (where method = 'siddon')) from differences
union all select printf('`geometry_free` is %.1f dB behind `world_unet`; a wrong arc costs %.1f dB', avg(psnr) filter (where method = 'world_unet' and arc = 180)
  - avg(psnr) filter (where method = 'geometry_free'), avg(psnr) filter (where method = 'world_unet' and arc = 180) - avg(psnr) filter (where method = 'world_unet' and arc = 200))
  from [experiments/24_geometry/results.csv] where steps = 800 and patients = 170
union all select printf('to %.1f and %.1f %%', (select 100 * [difference from NumPy] from [experiments/25_measured/synchrotron.csv]),
  (select 100 * [difference from NumPy] from [experiments/25_measured/neutron.csv] where correction = 'found'))
union all select printf('%.1f dB behind `cross_view` from robust SIRT', max(psnr) filter (where method like 'cross_view%') - max(psnr) filter (where method = 'dual_domain, narrow'))
  from (select method, avg(psnr) as psnr from [experiments/26_published/tuning.csv] where steps = 200 group by method, rate)
union all select printf('%.1f dB behind it after 800', max(psnr) filter (where method = 'cross_view from robust_sirt, narrow') - max(psnr) filter (where method = 'dual_domain, narrow'))
  from (select method, avg(psnr) as psnr from (select method, rate, seed, avg(psnr) as psnr from [experiments/26_published/tuning.csv] where steps = 800 group by method, rate, seed) group by method, rate)
union all select printf('after 4000 steps %.1f dB (three seeds', avg(a.psnr - b.psnr)) from [experiments/29_ray_weights/longer.csv] a join [experiments/29_ray_weights/longer.csv] b
  on b.[case] = a.[case] and b.seed = a.seed and b.method = 'world_unet from robust_sirt, narrow' where a.method = 'cross_view from robust_sirt, narrow'
union all select printf('and %.1f dB on aligned views', avg(a.psnr - b.psnr)) from [experiments/29_ray_weights/aligned.csv] a join [experiments/29_ray_weights/aligned.csv] b on b.[case] = a.[case] and b.seed = a.seed where a.method = 'cross_view from robust_sirt, narrow' and b.method = 'world_unet from robust_sirt, narrow'
union all select printf('by %.0f to %.0f in the log-likelihood', min(lead), max(lead)) from ahead
union all select printf('`robust_sirt`, %.1f dB ahead of SIRT', lead) from robust
union all select printf('%.1f dB ahead of `world_unet` if both start from SIRT', lead) from networks where method = 'cross_view'
union all select printf('%.1f dB from `robust_sirt`', lead) from networks where method = 'cross_view from robust_sirt'
union all select printf('from +%.0f to %.1f %%', mean, (select mean from [experiments/30_scan_effects/truncation.csv] where beam = 'parallel' and object = 'ball of 90 mm' and extrapolate = 'true'))
  from [experiments/30_scan_effects/truncation.csv] where beam = 'parallel' and object = 'ball of 90 mm' and extrapolate = 'false'
union all select printf('%.0f %% too high where a cavity ends', max(mean)) from [experiments/30_scan_effects/truncation.csv] where beam in ('parallel', 'fan') and extrapolate = 'true'
union all select printf('of water from %.0f to %.0f to at most %.1f %%', min(before), max(before), max(abs(after))) from [experiments/30_scan_effects/hardening.csv]
union all select printf('%d of %d scans with a right rig or another fault pass', sum(silent), count(*)) from checks where kind != 'wrong rig'
union all select printf('%d of %d wrong rigs of objects within the panel are named', sum(named), count(*)) from checks where kind = 'wrong rig' and not wide
union all select printf('%d of %d of wider ones', sum(named), count(*)) from checks where kind = 'wrong rig' and wide
union all select printf('from %d of %d starts with one view and with two', min(found), max(starts)) from descents where part = 'mvrecon'
union all select printf('in %.1f to %.1f s of a CPU thread', min(seconds), max(seconds)) from descents where part = 'mvrecon'
union all select printf('%.0f to %.0f times as long', min(a.seconds / b.seconds), max(a.seconds / b.seconds)) from descents a join descents b on b.views = a.views and b.part = 'mvrecon'
  where a.part = 'nanodrr, same descent'
union all select printf('(%+.2f +- %.2f dB for `cross_view`)', avg(own.psnr - unet.psnr), 2 * stdev(own.psnr - unet.psnr) / sqrt(count(*)))
  from [experiments/22_dcspect/cases_footprints.csv] own join [experiments/22_dcspect/cases_footprints.csv] unet
  on unet.[case] = own.[case] and unet.method = 'world_unet' where own.method = 'cross_view'
