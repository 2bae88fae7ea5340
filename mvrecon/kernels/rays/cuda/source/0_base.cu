// Common to all kernels, for NVRTC and, for tests on the CPU, a C++ compiler.
#ifdef __CUDACC__
#define DEVICE __device__ __forceinline__
#define UNROLL _Pragma("unroll")
#define PRAGMA(words) _Pragma(#words)
#define UNROLL_BY(n) PRAGMA(unroll n)
DEVICE void add(float* to, float value) { atomicAdd(to, value); }
DEVICE void add(double* to, double value) { atomicAdd(to, value); }
DEVICE void add_bits(int* to, int bits) { atomicOr(to, bits); }
DEVICE void add_greatest(int* to, int value) { atomicMax(to, value); }
// The sum over a warp, for its first thread.
template <class R> DEVICE R warp_sum(R value) {
  for (int i = 16; i; i >>= 1) value += __shfl_down_sync(0xffffffffu, value, i);
  return value;
}
DEVICE bool first_of_warp() { return threadIdx.x % 32 == 0; }
// Memory that the threads of a block fill together, each its part, before all synchronise.
#define SHARED __shared__
DEVICE int part_of_thread() { return threadIdx.x; }
DEVICE int parts_of_block() { return blockDim.x; }
DEVICE void wait_for_block() { __syncthreads(); }
// A number that is cast here, and not at every use again, in a loop.
DEVICE float settled(float x) { asm volatile("" : "+f"(x)); return x; }
DEVICE double settled(double x) { return x; }
#else
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstring>
#define DEVICE inline
#define UNROLL
#define UNROLL_BY(n)
#define __global__
#define __launch_bounds__(...)

using std::ceil; using std::exp; using std::expm1; using std::fabs; using std::floor; using std::fma; using std::max; using std::min; using std::sqrt;
struct Place { int x, y; };
static Place threadIdx, blockIdx;
template <class R> DEVICE void add(R* to, R value) { *to += value; }
DEVICE void add_bits(int* to, int bits) { *to |= bits; }
DEVICE void add_greatest(int* to, int value) { *to = max(*to, value); }
// Threads run sequentially, so all of them add to the sum over a warp.
template <class R> DEVICE R warp_sum(R value) { return value; }
DEVICE bool first_of_warp() { return true; }
// And each fills all of the shared memory.
#define SHARED static
DEVICE int part_of_thread() { return 0; }
DEVICE int parts_of_block() { return 1; }
DEVICE void wait_for_block() {}
template <class R> DEVICE R settled(R x) { return x; }
#endif

enum { BLOCK = 128, WARP = 32 };

struct Half { unsigned short bits; };
struct Brain { unsigned short bits; };
DEVICE float number(float value) { return value; }
DEVICE double number(double value) { return value; }
DEVICE float number(Brain value) {
  unsigned bits = (unsigned)value.bits << 16;
#ifdef __CUDACC__
  return __uint_as_float(bits);
#else
  float wide;
  memcpy(&wide, &bits, 4);
  return wide;
#endif
}
DEVICE float number(Half value) {
#ifdef __CUDACC__
  float wide;
  asm("cvt.f32.f16 %0, %1;" : "=f"(wide) : "h"(value.bits));
  return wide;
#else
  _Float16 narrow;
  memcpy(&narrow, &value.bits, 2);
  return (float)narrow;
#endif
}

template <class T, int NV> struct alignas(sizeof(T) * NV) Many { T n[NV]; };
template <class R> struct alignas(16) Quad { R a, b, c, d; };

// By comparison: an array indexed at run time would be in local memory.
template <class V> DEVICE V pick(const V* three, int axis) { return axis == 0 ? three[0] : axis == 1 ? three[1] : three[2]; }

DEVICE long long thread_of() { return (long long)blockIdx.x * BLOCK + threadIdx.x; }

template <class R> DEVICE R hat(R t) { return max((R)0, 1 - fabs(t)); }
