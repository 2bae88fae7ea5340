#define ENTRY(name, kernel) extern "C" __global__ void __launch_bounds__(BLOCK) name(const Field f) { kernel(f); }
#define WARP_OF(suffix, R, S)                                                                                            \
  ENTRY(invert##suffix, invert_maps)                                                                                   \
  ENTRY(warp##suffix, (warp_samples<R, S>))                                                                                 \
  ENTRY(warp_back##suffix, (gather_samples<R, S>))                                                                          \
  ENTRY(warp_vary##suffix, (vary_maps<R, S>))
#define LOOK_OF(suffix, R, S)                                                                                            \
  ENTRY(look##suffix, look_up<R>)                                                                                      \
  ENTRY(show##suffix, show_up<R>)
#define HULL_OF(suffix, R, S) ENTRY(judge##suffix, judge_bricks)
