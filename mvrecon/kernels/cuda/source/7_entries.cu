#define ENTRY_WITHIN(bounds, Packed, name, kernel) extern "C" __global__ void bounds name(const Packed f) { kernel(f); }
#define ENTRY_OF(Packed, name, kernel) ENTRY_WITHIN(__launch_bounds__(BLOCK), Packed, name, kernel)
#define ENTRY(name, kernel) ENTRY_OF(Field, name, kernel)
#define WARP_OF(suffix, R, S)                                                                                            \
  ENTRY(invert##suffix, invert_maps)                                                                                   \
  ENTRY(warp##suffix, (warp_samples<R, S>))                                                                                 \
  ENTRY(warp_back##suffix, (gather_samples<R, S>))                                                                          \
  ENTRY(warp_vary##suffix, (vary_maps<R, S>))
// Up to 128 registers: with fewer, which the compiler would choose, numbers go to local memory.
#define LOOK_OF(suffix, R, S)                                                                                            \
  ENTRY_WITHIN(__launch_bounds__(BLOCK, 4), Field, look##suffix, look_up<R>)                                           \
  ENTRY_WITHIN(__launch_bounds__(BLOCK, 4), Field, show##suffix, show_up<R>)
#define HULL_OF(suffix, R, S)                                                                                            \
  ENTRY(judge##suffix, judge_bricks)                                                                                   \
  ENTRY(count##suffix, count_bricks)
