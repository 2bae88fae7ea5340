#define ENTRY(name, kernel) extern "C" __global__ void __launch_bounds__(BLOCK) name(const Field f) { kernel(f); }
#define WARP_OF(suffix, R)                                                                                             \
  ENTRY(invert##suffix, invert_maps)                                                                                   \
  ENTRY(warp##suffix, warp_samples<R>)                                                                                 \
  ENTRY(warp_back##suffix, gather_samples<R>)                                                                          \
  ENTRY(warp_vary##suffix, vary_maps<R>)
#define LOOK_OF(suffix, R)                                                                                             \
  ENTRY(look##suffix, look_up<R>)                                                                                      \
  ENTRY(show##suffix, show_up<R>)
#define HULL_OF(suffix, R) ENTRY(judge##suffix, judge_bricks)
