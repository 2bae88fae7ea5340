// Voxel-driven back-projection: volumes [n d h w] of what voxels see in views [n m v u], by maps [m 4 2 3] of an index to u w,
// v w, w and the fraction of the ray; see `voxels/reference.py`.
// A block has a tile of voxels: threads along x and y, each with some along z. What it sees of a view is formed in float64 about
// the tile's anchor by one of its threads, and cast: counted from there, and from the pixel there, digits are those of a tile.
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

template <class R> DEVICE void look_up(const Field& f) {
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
