// Kernels along rays. The files of this folder are concatenated in the order of their names; `launch.py` adds one
// line for each variant.
//
// A variant has a type R of arithmetic, a stored type T of volumes, a number NV of volumes that share a ray's
// index work (1 or 4), and a method.
enum { JOSEPH = 0, SIDDON = 1, TRILINEAR = 2 };
// Flags of a view: bits 0 to 2 are main axes that occur, then: some ray ends inside the volume. Of all views: some main
// axis may be z.
enum { SHORT = 8, STEEP = 1, NONE = 3 };

// Arguments of a kernel, as in `launch.py`; a source that follows may have more.
struct Scene {
  const double* lines;    // [m 4 3 k]: direction, moment, start, world; k = 3, or 1 for explicit rays
  const void* volumes;    // [n d h w] of the stored part, input
  void* stores;           // twice [groups cells NV]: y, x, z (z fastest), then z, y, x
  void* views;            // [n m v u]
  void* rays;             // [p 2 4] or [p 3 4]: the records of `record_rays`
  unsigned char* axes;    // [p]: main axis, or NONE
  void* values;           // [groups p NV]: views times mm a slab
  float* frames;          // [m 3 4]: from voxels about the centre to (u w, v w, w) about the detector's centre
  int* flags;             // [1 + m]: of all views, of each
  void* results;          // volumes [n d h w] of the part, or sums [m warps 12 k]
  int* occupied;          // box (z0 y0 x0 z1 y1 x1) outside of which volumes are zero, or null
  double window[2];       // valid range of a ray
  int sizes[3];           // voxels of the whole along x, y, z
  int corner[3], part[3]; // the first voxel, and the number of voxels, of the stored part
  int n_views, rows, columns, maps, n_volumes, samples;
  int first_view, views_here;  // of the recorded rays
  int blocks_a_view;
};

struct Box { int low[3], high[3]; };
// The stored region: the part, and a voxel more, as rounding may move a ray.
DEVICE Box stored_box(const Scene& s) {
  Box box;
  UNROLL for (int i = 0; i < 3; i++) {
    box.low[i] = max(s.corner[i] - 1, 0);
    box.high[i] = min(s.corner[i] + s.part[i] + 1, s.sizes[i]);
  }
  return box;
}
// The box to which rays are clipped.
DEVICE Box read_box(const Scene& s) {
  Box box = stored_box(s);
  if (s.occupied) UNROLL for (int i = 0; i < 3; i++) {
    box.low[i] = max(box.low[i], s.occupied[2 - i] - 1);
    box.high[i] = min(box.high[i], s.occupied[5 - i] + 1);
  }
  return box;
}

struct Pixel { int view, v, u; };
// The pixel of a thread: 32 rows of a column are a warp, four columns a block; on small detectors in one row.
DEVICE Pixel pixel_of(const Scene& s) {
  int high = s.rows >= WARP && s.columns >= BLOCK / WARP ? WARP : 1, wide = high == 1 ? 1 : BLOCK / WARP;
  long long thread = thread_of(), tile = thread / (high * wide);
  int inside = (int)(thread % (high * wide)), down = (s.rows + high - 1) / high, across = (s.columns + wide - 1) / wide;
  Pixel p;
  p.view = (int)(tile / ((long long)down * across));
  int rest = (int)(tile % ((long long)down * across));
  p.v = rest % down * high + inside % high;
  p.u = rest / down * wide + inside / high;
  return p;
}
DEVICE bool on_detector(const Scene& s, Pixel p) { return p.view < s.n_views && p.v < s.rows && p.u < s.columns; }
DEVICE long long index_of(const Scene& s, int view, int v, int u) { return ((long long)view * s.rows + v) * s.columns + u; }
