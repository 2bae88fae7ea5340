// Kernels of a thread a voxel, sample or pixel: warps, images of voxels, footprints of bricks. The files of this folder are
// read behind `rays/cuda/source/0_base.cu`, in the order of their names; each ends with a macro of its kernels,
// and `launch.py` adds a line for those wanted.
// R is the type of arithmetic, S the stored type, which may be half. Positions are computed in float64, and cast where they are small.

// Arguments of a kernel, as in `launch.py`.
struct Field {
  const double* maps;    // of a warp [s k 5 2 3], of images [m 4 2 3], of footprints [m 17]
  float* inverse;        // of a warp [s k 5 2 3]: from places to samples; zero where there is no such map
  const void* origin;    // input
  const void* by;        // the second factor of a derivative
  void* result;          // output
  double window[2];      // valid range of a ray
  int source[3];         // x, y, z of the input lattice; of views u, v
  int shape[3];          // x, y, z of the samples, voxels or bricks
  int sources, kinds, items, channels;  // s, k, n, c; views are kinds
  int blocks;            // of a pair (s, k)
  int weighted;          // divide values by the squared distance
  int voxels[3];         // x, y, z of a grid, whose bricks have an edge of so many
  int edge, enough, keep_unseen, parallel;
  double reach;
};

DEVICE int size_of(const int* three) { return three[0] * three[1] * three[2]; }
DEVICE double middle(int size) { return (size - 1) * 0.5; }
DEVICE bool within(int i, int size) { return (unsigned)i < (unsigned)size; }

// One over a number, in float to its last digit: the compiler's own division calls a function where a number is tiny.
DEVICE double inverse(double x) { return 1 / x; }
DEVICE float inverse(float x) {
#ifdef __CUDACC__
  float per;
  asm("rcp.approx.f32 %0, %1;" : "=f"(per) : "f"(x));
  return per;
#else
  return 1 / x;
#endif
}

// A bilinear map [2 3] at a centred index.
template <class T> DEVICE T value(const T* map, const T* p) {
  return map[0] * p[0] + map[1] * p[1] + map[2] + p[2] * (map[3] * p[0] + map[4] * p[1] + map[5]);
}

// The index (x, y, z) of a flat one.
DEVICE void unravel(const int* shape, int flat, int* index) {
  index[0] = flat % shape[0];
  index[1] = flat / shape[0] % shape[1];
  index[2] = flat / shape[0] / shape[1];
}

#define ENTRY_WITHIN(bounds, name, kernel) extern "C" __global__ void bounds name(const Field f) { kernel(f); }
#define ENTRY(name, kernel) ENTRY_WITHIN(__launch_bounds__(BLOCK), name, kernel)
