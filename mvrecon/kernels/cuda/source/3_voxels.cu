// Voxel-driven back-projection: volumes [n d h w] from views [n m v u], by maps [m 4 2 3] of an index to u w,
// v w, w and the fraction of the ray; see `voxels/__init__.py`.
// A block has a tile of voxels: threads along x and y, each with some along z. Its image in a view is computed in float64 about
// the tile's anchor by one of its threads, and cast: relative to that, and to its pixel, float32 has the precision of a tile.
enum { IMAGE = 24, RIGHT = 16, DOWN = 8, ALONG = 8, VIEWS = 64 };  // numbers of a map; of a tile; views that a block prepares at once

// The pixel nearest to a place, on the detector.
DEVICE int pixel_at(double top, double under, int size) {
  double place = top / under + middle(size);
  return under > 0 ? (int)min(max(floor(place), 0.0), size - 1.0) : 0;
}

// A view from a tile: u w and v w, counted from a pixel, w, and the fraction of the ray, counted from the anchor's.
template <class R> struct Sight {
  Near<R> u, v, w, way;
  R begin, end;
  int u0, v0;
  Sight() = default;
  DEVICE Sight(const Field& f, const double* map, const double* p) {
    double under = value(map + 12, p), fraction = value(map + 18, p);
    u0 = pixel_at(value(map, p), under, f.source[0]);
    v0 = pixel_at(value(map + 6, p), under, f.source[1]);
    u = Near<R>(map, map + 12, u0 - middle(f.source[0]), p);
    v = Near<R>(map + 6, map + 12, v0 - middle(f.source[1]), p);
    w = Near<R>(map + 12, map, 0, p);
    way = Near<R>(map + 18, map, 0, p);
    way.one = 0;
    begin = (R)(f.window[0] - fraction);
    end = (R)(f.window[1] - fraction);
  }
};

// A function of a tile's voxels along z: first + t step.
template <class R> struct Ramp {
  R first, step;
  DEVICE Ramp(const Near<R>& n, R x, R y) : first(n.one + x * n.x + y * n.y), step(n.z + x * n.xz + y * n.yz) {}
  DEVICE R at(int t) const { return first + (R)(t - ALONG / 2) * step; }
};

template <class R> DEVICE R bilinear(const Field& f, const R* view, R u, R v, int u0, int v0) {
  R low_u = floor(u), low_v = floor(v), x = u - low_u, y = v - low_v, sum = 0;
  int left = u0 + (int)low_u, top = v0 + (int)low_v;
  UNROLL for (int n = 0; n < 4; n++) {
    int column = left + n % 2, row = top + n / 2;
    R weight = (n % 2 ? x : 1 - x) * (n / 2 ? y : 1 - y);
    if (within(column, f.source[0]) && within(row, f.source[1])) sum += weight * view[(long long)row * f.source[0] + column];
  }
  return sum;
}

template <class R> DEVICE void see(const Field& f, const Sight<R>& sight, const R* view, R x, R y, R* total) {
  Ramp<R> us(sight.u, x, y), vs(sight.v, x, y), under(sight.w, x, y), way(sight.way, x, y);
  R begin = sight.begin, end = sight.end;
  R low_u = (R)(-1 - sight.u0), high_u = (R)(f.source[0] - sight.u0), low_v = (R)(-1 - sight.v0), high_v = (R)(f.source[1] - sight.v0);
  UNROLL for (int t = 0; t < ALONG; t++) {
    R w = under.at(t), per = inverse(w), u = us.at(t) * per, v = vs.at(t) * per, share = way.at(t);
    bool counts = w > 0 && begin < share && share < end && low_u < u && u < high_u && low_v < v && v < high_v;
    if (counts) total[t] += (f.weighted ? per * per : (R)1) * bilinear(f, view, u, v, sight.u0, sight.v0);
  }
}

template <class R> DEVICE void backproject_voxels(const Field& f) {
  SHARED Sight<R> sights[VIEWS];
  const int tile[3] = {RIGHT, DOWN, ALONG};
  int tiles[3], low[3];
  UNROLL for (int i = 0; i < 3; i++) tiles[i] = (f.shape[i] + tile[i] - 1) / tile[i];
  unravel(tiles, (int)blockIdx.x, low);
  double anchor[3];
  UNROLL for (int i = 0; i < 3; i++) {
    low[i] *= tile[i];
    anchor[i] = low[i] + tile[i] / 2 - middle(f.shape[i]);
  }
  int right = threadIdx.x % RIGHT, down = threadIdx.x / RIGHT;
  R x = (R)(right - RIGHT / 2), y = (R)(down - DOWN / 2), total[ALONG] = {};
  long long pixels = (long long)f.source[0] * f.source[1], plane = (long long)f.shape[0] * f.shape[1];
  const R* view = (const R*)f.origin + (long long)blockIdx.y * f.kinds * pixels;
  for (int first = 0; first < f.kinds; first += VIEWS) {
    int here = min(f.kinds - first, (int)VIEWS);
    wait_for_block();
    for (int m = part_of_thread(); m < here; m += parts_of_block()) sights[m] = Sight<R>(f, f.maps + (long long)(first + m) * IMAGE, anchor);
    wait_for_block();
    for (int m = 0; m < here; m++, view += pixels) see(f, sights[m], view, x, y, total);
  }
  right += low[0];
  down += low[1];
  if (right >= f.shape[0] || down >= f.shape[1]) return;
  R* volume = (R*)f.result + ((long long)blockIdx.y * f.shape[2] + low[2]) * plane + (long long)down * f.shape[0] + right;
  UNROLL for (int t = 0; t < ALONG; t++)
    if (low[2] + t < f.shape[2]) volume[t * plane] = total[t];
}

// The exact transpose of `backproject_voxels`: a thread a pixel, which goes along its ray slab by slab, to the voxels whose images may
// touch it. No atomics.

// The ray of a pixel (u, v) about the detector's centre: direction and moment of where two planes meet,
// (R_u - u R_w) x + .. = 0 and (R_v - v R_w) x + .. = 0; both are linear in u and v.
struct Pencil {
  double direction[3], moment[3];
  DEVICE Pencil(const double* map, double u, double v) {
    double one[4], two[4];
    UNROLL for (int i = 0; i < 4; i++) {
      int at = i < 2 ? i : i == 2 ? 5 : 2;  // factors of x, y, z, 1
      one[i] = map[at] - u * map[12 + at];
      two[i] = map[6 + at] - v * map[12 + at];
    }
    UNROLL for (int i = 0; i < 3; i++) {
      int p = (i + 1) % 3, q = (i + 2) % 3;
      direction[i] = one[p] * two[q] - one[q] * two[p];
      moment[i] = two[3] * one[i] - one[3] * two[i];
    }
  }
};

// The four corners of a pixel's beam in slabs of an axis: along axis b and c, of all four.
struct Beam {
  float from[4][2], by[4][2];
  bool bounded;
  DEVICE Beam(const double* map, double u, double v, int axis) {
    int ahead = 0, behind = 0, b = (axis + 1) % 3, c = (axis + 2) % 3;
    UNROLL for (int n = 0; n < 4; n++) {
      Pencil ray(map, u + (n % 2 ? 1 : -1), v + (n / 2 ? 1 : -1));
      double along = pick(ray.direction, axis), per = inverse(along);
      ahead += along > 0;
      behind += along < 0;
      from[n][0] = (float)(pick(ray.moment, c) * per);
      from[n][1] = (float)(-pick(ray.moment, b) * per);
      by[n][0] = (float)(pick(ray.direction, b) * per);
      by[n][1] = (float)(pick(ray.direction, c) * per);
    }
    bounded = ahead == 4 || behind == 4;
  }
  // The voxels of a slab, s about the centre, along one of the two axes: the first, and the last among them.
  DEVICE void range(int side, float s, int size, int& first, int& last) const {
    float low = 1e30f, high = -1e30f, centre = (size - 1) * 0.5f, slack = 0.02f + 1e-5f * size;
    UNROLL for (int n = 0; n < 4; n++) {
      low = min(low, from[n][side] + s * by[n][side]);
      high = max(high, from[n][side] + s * by[n][side]);
    }
    first = bounded ? (int)ceil(min(max(low + centre - slack, 0.0f), (float)size)) : 0;
    last = bounded ? (int)floor(max(min(high + centre + slack, size - 1.0f), -1.0f)) : size - 1;
  }
};

// A linear function on a slab, counted from its first voxel, in digits of a pixel.
template <class R> struct Slab {
  R one, b, c;
  DEVICE Slab(const double* row, const double* by, double times, const double* p, int axis_b, int axis_c) {
    double factor[3] = {row[0] - times * by[0], row[1] - times * by[1], row[5] - times * by[5]};
    one = settled((R)(factor[0] * p[0] + factor[1] * p[1] + factor[2] * p[2] + (row[2] - times * by[2])));
    b = settled((R)pick(factor, axis_b));
    c = settled((R)pick(factor, axis_c));
  }
  DEVICE R at(int i, int j) const { return one + (R)i * b + (R)j * c; }
};

template <class R> DEVICE void project_voxels(const Field& f) {
  long long at = thread_of(), pixels = (long long)f.source[0] * f.source[1], plane = (long long)f.shape[0] * f.shape[1];
  int m = (int)(at / pixels);
  if (m >= f.kinds) return;
  const double* map = f.maps + (long long)m * IMAGE;
  double u = at % f.source[0] - middle(f.source[0]), v = at / f.source[0] % f.source[1] - middle(f.source[1]);
  Pencil ray(map, u, v);
  double dx = fabs(ray.direction[0]), dy = fabs(ray.direction[1]), dz = fabs(ray.direction[2]);
  int axis = dx >= dy && dx >= dz ? 0 : dy >= dz ? 1 : 2, b = (axis + 1) % 3, c = (axis + 2) % 3;
  Beam beam(map, u, v, axis);
  const R* volume = (const R*)f.origin + (long long)blockIdx.y * plane * f.shape[2];
  long long step_b = b == 0 ? 1 : b == 1 ? f.shape[0] : plane, step_c = c == 0 ? 1 : c == 1 ? f.shape[0] : plane;
  long long step = axis == 0 ? 1 : axis == 1 ? f.shape[0] : plane;
  R total = 0;
  for (int slab = 0; slab < pick(f.shape, axis); slab++) {
    int low_b, high_b, low_c, high_c;
    double s = slab - middle(pick(f.shape, axis)), p[3];
    beam.range(0, (float)s, pick(f.shape, b), low_b, high_b);
    beam.range(1, (float)s, pick(f.shape, c), low_c, high_c);
    if (low_b > high_b || low_c > high_c) continue;
    UNROLL for (int i = 0; i < 3; i++) p[i] = i == axis ? s : (i == b ? low_b : low_c) - middle(f.shape[i]);
    Slab<R> us(map, map + 12, u, p, b, c), vs(map + 6, map + 12, v, p, b, c), under(map + 12, map, 0, p, b, c);
    Slab<R> way(map + 18, map, 0, p, b, c);
    double fraction = map[18] * p[0] + map[19] * p[1] + map[23] * p[2] + map[20];
    R begin = settled((R)(f.window[0] - fraction)), end = settled((R)(f.window[1] - fraction));
    way.one = 0;
    for (int j = low_c; j <= high_c; j++)
      for (int i = low_b; i <= high_b; i++) {
        int x = i - low_b, y = j - low_c;
        R w = under.at(x, y), per = inverse(w), weight = hat(us.at(x, y) * per) * hat(vs.at(x, y) * per), share = way.at(x, y);
        if (!(w > 0 && weight > 0 && begin < share && share < end)) continue;
        total += weight * (f.weighted ? per * per : (R)1) * volume[slab * step + i * step_b + j * step_c];
      }
  }
  ((R*)f.result)[(long long)blockIdx.y * f.kinds * pixels + at] = total;
}

// Up to 128 registers: with fewer, which the compiler would choose, numbers go to local memory.
#define VOXELS_OF(suffix, R, ...)                                                                                      \
  ENTRY_WITHIN(__launch_bounds__(BLOCK, 4), voxel_backproject##suffix, backproject_voxels<R>)                          \
  ENTRY_WITHIN(__launch_bounds__(BLOCK, 4), voxel_project##suffix, project_voxels<R>)
