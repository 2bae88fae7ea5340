// A prototype: Joseph's method on a GPU, as one source for NVRTC and for a C++ compiler. prototype.py runs and times it.
// NV volumes share a ray's index work (1 or 4). Volumes are read z-fastest, [y][x][z][NV] with a border of zeros; rays
// whose main axis is z read a second store, [z][y][x][NV]. Threads of a warp are rows of one detector column.
#ifndef __CUDACC__
#include <algorithm>
#include <cmath>
#define __device__
#define __global__
#define __forceinline__ inline
#define __restrict__
static int host_thread, host_block, host_block_y;
#define THREAD host_thread
#define BLOCK_X host_block
#define BLOCK_Y host_block_y
static inline void add_flag(int* at, int bits) { *at |= bits; }
using std::max; using std::min; using std::fabs; using std::ceil; using std::floor; using std::sqrt;
#else
#define THREAD ((int)threadIdx.x)
#define BLOCK_X ((int)blockIdx.x)
#define BLOCK_Y ((int)blockIdx.y)
__device__ static inline void add_flag(int* at, int bits) { atomicOr(at, bits); }
#endif
#ifndef NV
#define NV 1
#endif
#define ROWS_A_WARP 32
#define BLOCK 128

struct alignas(16) Quad { float a, b, c, d; };
struct alignas(4 * NV) Many { float n[NV]; };

struct Scene {
  const double* lines;   // [m 4 3 3]: direction, moment, start, world
  const Many* tall;      // [y][x][z]
  const Many* flat;      // [z][y][x], or nothing where no ray's main axis is z
  float* views;          // [n m v u]
  Quad* rays;            // [m v u]: b, its slope, c, its slope, voxels without their border
  Quad* ends;            // [m v u]: begin, end, main axis, nothing
  Many* values;          // [m v u]: views times mm a slab
  const float* frames;   // [m 3 4] from voxels about the centre to (u w, v w, w)
  int* flags;            // [m] bits 0..2: main axes that occur; bit 3: a ray that ends inside
  float* volume;         // [n z y x]
  int sizes[3];          // x, y, z
  int views_, rows, columns, count;  // count: of volumes
  double window[2];
};

// By comparison: an array of parameters that is indexed at run time would be copied to local memory.
__device__ __forceinline__ int size_of(const Scene& s, int axis) {
  return axis == 0 ? s.sizes[0] : axis == 1 ? s.sizes[1] : s.sizes[2];
}

struct Ray { int axis, far, near, first, last; double b, slope_b, c, slope_c, centre; float begin, end, length; };

__device__ __forceinline__ double at(const double* line, int kind, int axis, double u, double v) {
  const double* p = line + (kind * 3 + axis) * 3;
  return p[0] * u + p[1] * v + p[2];
}

__device__ __forceinline__ void across(double value, double slope, double half, double& lower, double& upper) {
  if (slope == 0) {
    if (!(-half <= value && value < half)) { lower = 0; upper = -1; }
    return;
  }
  double per = 1.0 / slope, one = (-half - value) * per, two = (half - value) * per;
  lower = max(lower, min(one, two));
  upper = min(upper, max(one, two));
}

__device__ __forceinline__ Ray trace(const Scene& s, const double* line, double u, double v) {
  Ray ray;
  double d[3] = {at(line, 0, 0, u, v), at(line, 0, 1, u, v), at(line, 0, 2, u, v)};
  double x = fabs(d[0]), y = fabs(d[1]), z = fabs(d[2]);
  const double tie = 1e-12;
  int a = (x * (1 + tie) >= y && x * (1 + 2 * tie) >= z) ? 0 : (y * (1 + tie) >= z ? 1 : 2);
  int near = a == 2 ? 0 : 2, far = 3 - a - near;
  double da = a == 0 ? d[0] : a == 1 ? d[1] : d[2], db = far == 0 ? d[0] : d[1], dc = near == 0 ? d[0] : d[2];
  double per = 1.0 / da;
  ray.axis = a; ray.far = far; ray.near = near;
  ray.slope_b = db * per; ray.slope_c = dc * per;
  double mb = at(line, 1, 3 - a - far, u, v), mc = at(line, 1, 3 - a - near, u, v);
  double value_b = ((far + 1) % 3 == a ? mb : -mb) * per, value_c = ((near + 1) % 3 == a ? mc : -mc) * per;
  double start = at(line, 2, a, u, v), one = start + s.window[0] * da, two = start + s.window[1] * da;
  int na = size_of(s, a), nb = size_of(s, far), nc = size_of(s, near);
  double half = na * 0.5, begin = max(-half, min(one, two)), end = min(half, max(one, two));
  double enter = begin - 0.5, leave = end + 0.5;
  across(value_b, ray.slope_b, nb * 0.5 + 0.5, enter, leave);
  across(value_c, ray.slope_c, nc * 0.5 + 0.5, enter, leave);
  ray.centre = (na - 1) * 0.5;
  ray.first = ray.last = 0;
  if (begin < end && enter <= leave) {
    ray.first = max(0, (int)ceil(enter + ray.centre));
    ray.last = min(na, (int)floor(leave + ray.centre) + 1);
    ray.first += ray.first + 0.5 <= begin + ray.centre;
    ray.last -= ray.last - 1.5 >= end + ray.centre;
  }
  ray.b = value_b + (nb - 1) * 0.5; ray.c = value_c + (nc - 1) * 0.5;
  ray.begin = (float)begin; ray.end = (float)end;
  float wx = (float)at(line, 3, 0, u, v), wy = (float)at(line, 3, 1, u, v), wz = (float)at(line, 3, 2, u, v);
  ray.length = sqrt(wx * wx + wy * wy + wz * wz) * (float)fabs(per);
  return ray;
}

// The slab at s: bilinear in the two other axes.
__device__ __forceinline__ void step(const Many* __restrict__ from, int far, float b, float c, float share, float* total) {
  int ib = (int)b, ic = (int)c;
  const Many* p = from + (ib * far + ic);
  float y = b - (float)ib, z = c - (float)ic;
  Many low = p[0], high = p[1], low2 = p[far], high2 = p[far + 1];
#pragma unroll
  for (int n = 0; n < NV; n++) {
    float lower = low.n[n] + z * (high.n[n] - low.n[n]), upper = low2.n[n] + z * (high2.n[n] - low2.n[n]);
    total[n] += share * (lower + y * (upper - lower));
  }
}

extern "C" __global__ void project(const Scene s) {
  int tiles = (s.rows + ROWS_A_WARP - 1) / ROWS_A_WARP, wide = (s.columns + 3) / 4;
  int block = BLOCK_X, m = block / (tiles * wide), tile = block % (tiles * wide);
  int v = tile % tiles * ROWS_A_WARP + THREAD % ROWS_A_WARP, u = tile / tiles * 4 + THREAD / ROWS_A_WARP;
  int first_volume = BLOCK_Y * NV;
  if (m >= s.views_ || v >= s.rows || u >= s.columns) return;
  Ray ray = trace(s, s.lines + m * 36, u - (s.columns - 1) * 0.5, v - (s.rows - 1) * 0.5);
  int X = s.sizes[0] + 3, Y = s.sizes[1] + 3, Z = s.sizes[2] + 3;
  int along = ray.axis == 2 ? X * Y : ray.axis == 0 ? Z : X * Z, far = ray.axis == 2 ? X : ray.axis == 0 ? X * Z : Z;
  const Many* from = (ray.axis == 2 ? s.flat : s.tall) + (long long)BLOCK_Y * X * Y * Z + (ray.first + 1) * along;
  float slope_b = (float)ray.slope_b, slope_c = (float)ray.slope_c;
  float b = (float)(ray.b + 1), c = (float)(ray.c + 1), centre = (float)ray.centre;
  float total[NV] = {0};
  if (ray.first < ray.last) {
    // the first and the last slab may hold a part of the ray; those between are whole
    float at_first = ray.first - centre, at_last = ray.last - 1 - centre;
    step(from, far, b + at_first * slope_b, c + at_first * slope_c,
         min(ray.end, at_first + 0.5f) - max(ray.begin, at_first - 0.5f), total);
    int k = ray.first + 1;
#pragma unroll 4
    for (; k < ray.last - 1; k++) {
      from += along;
      float place = (float)k - centre;
      step(from, far, b + place * slope_b, c + place * slope_c, 1.0f, total);
    }
    if (ray.last - ray.first > 1)
      step(from + along, far, b + at_last * slope_b, c + at_last * slope_c,
           min(ray.end, at_last + 0.5f) - max(ray.begin, at_last - 0.5f), total);
  }
  long long pixel = ((long long)m * s.rows + v) * s.columns + u, all = (long long)s.views_ * s.rows * s.columns;
#pragma unroll
  for (int n = 0; n < NV; n++)
    if (first_volume + n < s.count) s.views[(first_volume + n) * all + pixel] = ray.length * total[n];
}

extern "C" __global__ void record(const Scene s) {
  long long pixel = (long long)BLOCK_X * BLOCK + THREAD, all = (long long)s.views_ * s.rows * s.columns;
  if (pixel >= all) return;
  int u = pixel % s.columns, v = pixel / s.columns % s.rows, m = pixel / ((long long)s.columns * s.rows);
  Ray ray = trace(s, s.lines + m * 36, u - (s.columns - 1) * 0.5, v - (s.rows - 1) * 0.5);
  bool there = ray.first < ray.last;
  int group = BLOCK_Y;
  Many value;
#pragma unroll
  for (int n = 0; n < NV; n++)
    value.n[n] = there && group * NV + n < s.count ? ray.length * s.views[(group * NV + n) * all + pixel] : 0.0f;
  s.values[group * all + pixel] = value;
  if (group) return;
  // far away: its hat is zero at every voxel
  Quad kept = {there ? (float)ray.b : -1e9f, (float)ray.slope_b, there ? (float)ray.c : -1e9f, (float)ray.slope_c};
  s.rays[pixel] = kept;
  Quad ends = {ray.begin, ray.end, (float)ray.axis, 0};
  s.ends[pixel] = ends;
  if (!there) return;
  float half = size_of(s, ray.axis) * 0.5f;
  add_flag(s.flags + m, 1 << ray.axis | (ray.begin > -half || ray.end < half ? 8 : 0));
}

// What one view gives to a voxel through rays of one main axis.
template <bool WHOLE>
__device__ __forceinline__ void collect(const Scene& s, const float* P, long long start, const int* at_, const float* X,
                                        int axis, float* total) {
  int near = axis == 0 ? 1 : 0, far = 3 - axis - near;
  float U = P[0] * X[0] + P[1] * X[1] + P[2] * X[2] + P[3];
  float V = P[4] * X[0] + P[5] * X[1] + P[6] * X[2] + P[7];
  float W = P[8] * X[0] + P[9] * X[1] + P[10] * X[2] + P[11];
  float least = fabs(W) - fabs(P[8 + far]) - fabs(P[8 + near]);
  int u0 = 0, u1 = s.columns - 1, v0 = 0, v1 = s.rows - 1;
  if (least > 0.001f * fabs(W)) {
    float per = 1.0f / W, u = U * per, v = V * per, less = 1.0f / least;
    float du = (fabs(P[far] - u * P[8 + far]) + fabs(P[near] - u * P[8 + near])) * less;
    float dv = (fabs(P[4 + far] - v * P[8 + far]) + fabs(P[4 + near] - v * P[8 + near])) * less;
    float slack = 0.01f + 4e-6f * max(s.columns, s.rows), cu = (s.columns - 1) * 0.5f, cv = (s.rows - 1) * 0.5f;
    u0 = (int)ceil(min(max(u - du - slack + cu, 0.0f), (float)s.columns));
    u1 = (int)floor(max(min(u + du + slack + cu, s.columns - 1.0f), -1.0f));
    v0 = (int)ceil(min(max(v - dv - slack + cv, 0.0f), (float)s.rows));
    v1 = (int)floor(max(min(v + dv + slack + cv, s.rows - 1.0f), -1.0f));
  }
  // as the projection counts them: for the x axis y is far and z near, for y x and z, for z y and x
  float slab = X[axis];
  int one = axis == 2 ? 1 : axis == 0 ? 1 : 0, two = axis == 2 ? 0 : 2;
  float b = (float)at_[one], c = (float)at_[two];
  for (int v = v0; v <= v1; v++) {
    long long row = start + (long long)v * s.columns;
    for (int u = u0; u <= u1; u++) {
      Quad ray = s.rays[row + u];
      float by = 1.0f - fabs(ray.a + slab * ray.b - b), cz = 1.0f - fabs(ray.c + slab * ray.d - c);
      float weight = max(by, 0.0f) * max(cz, 0.0f);
      if (!WHOLE) {
        Quad ends = s.ends[row + u];
        float share = max(0.0f, min(ends.b, slab + 0.5f) - max(ends.a, slab - 0.5f));
        weight = ends.c == (float)axis ? weight * share : 0.0f;
      }
      Many value = s.values[row + u];
#pragma unroll
      for (int n = 0; n < NV; n++) total[n] += weight * value.n[n];
    }
  }
}

extern "C" __global__ void gather(Scene s) {
  long long voxel = (long long)BLOCK_X * BLOCK + THREAD, size = (long long)s.sizes[0] * s.sizes[1] * s.sizes[2];
  if (voxel >= size) return;
  int group = BLOCK_Y;
  long long pixels = (long long)s.rows * s.columns;
  s.values += group * s.views_ * pixels;
  int at_[3] = {(int)(voxel % s.sizes[0]), (int)(voxel / s.sizes[0] % s.sizes[1]), (int)(voxel / ((long long)s.sizes[0] * s.sizes[1]))};
  float X[3];
  for (int i = 0; i < 3; i++) X[i] = at_[i] - (s.sizes[i] - 1) * 0.5f;
  float total[NV] = {0};
  for (int m = 0; m < s.views_; m++) {
    int flags = s.flags[m], axes = flags & 7;
    const float* P = s.frames + m * 12;
    if (flags == 1) collect<true>(s, P, m * pixels, at_, X, 0, total);
    else if (flags == 2) collect<true>(s, P, m * pixels, at_, X, 1, total);
    else
      for (int axis = 0; axis < 3; axis++)
        if (axes >> axis & 1) collect<false>(s, P, m * pixels, at_, X, axis, total);
  }
#pragma unroll
  for (int n = 0; n < NV; n++)
    if (group * NV + n < s.count) s.volume[(group * NV + n) * size + voxel] = total[n];
}

// Volumes [n z y x] as a store with its border; tall: [y][x][z], else [z][y][x].
extern "C" __global__ void store(const float* __restrict__ volumes, Many* into, int x, int y, int z, int count, int tall) {
  long long cell = (long long)BLOCK_X * BLOCK + THREAD, X = x + 3, Y = y + 3, Z = z + 3;
  if (cell >= X * Y * Z) return;
  int k = tall ? cell % Z : cell / (X * Y), i = tall ? cell / Z % X : cell % X, j = tall ? cell / (Z * X) : cell / X % Y;
  int inside = i >= 1 && i <= x && j >= 1 && j <= y && k >= 1 && k <= z;
  long long size = (long long)x * y * z, from = ((long long)(k - 1) * y + (j - 1)) * x + (i - 1);
  Many value;
#pragma unroll
  for (int n = 0; n < NV; n++)
    value.n[n] = inside && BLOCK_Y * NV + n < count ? volumes[(BLOCK_Y * NV + n) * size + from] : 0.0f;
  into[BLOCK_Y * X * Y * Z + cell] = value;
}

#ifndef __CUDACC__
extern "C" void host_run(int kernel, const Scene* s, int blocks, int groups) {
  for (host_block_y = 0; host_block_y < groups; host_block_y++)
    for (host_block = 0; host_block < blocks; host_block++)
      for (host_thread = 0; host_thread < BLOCK; host_thread++)
        kernel == 0 ? project(*s) : kernel == 1 ? record(*s) : gather(*s);
}
extern "C" void host_store(const float* volumes, Many* into, int x, int y, int z, int count, int tall, int blocks, int groups) {
  for (host_block_y = 0; host_block_y < groups; host_block_y++)
    for (host_block = 0; host_block < blocks; host_block++)
      for (host_thread = 0; host_thread < BLOCK; host_thread++) store(volumes, into, x, y, z, count, tall);
}
#endif
