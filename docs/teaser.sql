-- The words with numbers of the caption of docs/images/teaser.png.
with gains as (
  select own.[case], own.psnr - robust.psnr as gain, unet.psnr as unet
  from [experiments/29_ray_weights/networks.csv] own
  join [experiments/29_ray_weights/networks.csv] unet on unet.[case] = own.[case] and unet.faults = own.faults and unet.seed = own.seed and unet.method = 'world_unet'
  join [experiments/29_ray_weights/classical.csv] robust on robust.[case] = own.[case] and robust.faults = own.faults and robust.method = 'robust_sirt'
  where own.method = 'cross_view' and own.seed = 0 and own.faults like '%rod%'
)
select printf('a 3-D U-Net (not drawn) has %.1f dB', (select unet from gains where [case] = 9)),
  iif(2 * (select count(*) from gains where gain < (select gain from gains where [case] = 9)) + 1 = count(*), printf('is the median of %d patients', count(*)), null)
from gains
