// Volumes [n s c d h w] through maps [s k 5 2 3] as values [n s k c d h w], trilinearly: see `warps/__init__.py`.
enum { PLANES = 8, X = 0, Y = 6, Z = 12, ACROSS = 18, DEPTH = 24, MAP = 30 };  // PLANES: channels of a thread

// The work of a thread: an item n, some channels, and a source with one of its maps. A plane is a channel.
struct Part {
  int pair, here;
  long long volume, values;  // planes before the first channel's
  DEVICE Part(const Field& f, int source, int k) : pair(source * f.kinds + k) {
    int groups = (f.channels + PLANES - 1) / PLANES, n = (int)blockIdx.y / groups, first = (int)blockIdx.y % groups * PLANES;
    here = min(f.channels - first, (int)PLANES);
    volume = ((long long)n * f.sources + source) * f.channels + first;
    values = ((long long)n * f.sources * f.kinds + pair) * f.channels + first;
  }
};

// Position of a sample in its source: the eight voxels around it, and the fractions between them.
template <class R> struct Cell {
  bool counts;
  int at[8];  // -1: outside the source, zero
  R part[3];
  double p[3], place[3], per[3];  // about the centre; and inverse denominators
  DEVICE Cell(const Field& f, const double* map, int sample) {
    int index[3], low[3];
    unravel(f.shape, sample, index);
    UNROLL for (int i = 0; i < 3; i++) p[i] = index[i] - middle(f.shape[i]);
    double across = value(map + ACROSS, p), depth = value(map + DEPTH, p);
    counts = across > 0 && depth > 0;
    per[0] = per[1] = inverse(across);
    per[2] = inverse(depth);
    UNROLL for (int i = 0; i < 3; i++) {
      place[i] = value(map + 6 * i, p) * per[i];
      double from_first = place[i] + middle(f.source[i]);
      counts = counts && from_first > -1 && from_first < f.source[i];
      if (!counts) from_first = 0;
      low[i] = (int)floor(from_first);
      part[i] = settled((R)(from_first - low[i]));
    }
    UNROLL for (int n = 0; n < 8; n++) {
      int x = low[0] + n % 2, y = low[1] + n / 2 % 2, z = low[2] + n / 4;
      bool inside = counts && within(x, f.source[0]) && within(y, f.source[1]) && within(z, f.source[2]);
      at[n] = inside ? (z * f.source[1] + y) * f.source[0] + x : -1;
    }
  }
  DEVICE R side(int n, int axis) const { return n >> axis & 1 ? part[axis] : 1 - part[axis]; }
  template <class S> DEVICE R voxel(const S* volume, int n) const { return at[n] < 0 ? (R)0 : (R)number(volume[at[n]]); }
};

template <class R, class S> DEVICE void warp_samples(const Field& f) {
  int pair = blockIdx.x / f.blocks, sample = blockIdx.x % f.blocks * BLOCK + threadIdx.x, samples = size_of(f.shape);
  if (sample >= samples) return;
  Part part(f, pair / f.kinds, pair % f.kinds);
  Cell<R> cell(f, f.maps + (long long)pair * MAP, sample);
  R weight[8];
  UNROLL for (int n = 0; n < 8; n++) weight[n] = cell.side(n, 0) * cell.side(n, 1) * cell.side(n, 2);
  long long voxels = size_of(f.source);
  const S* volume = (const S*)f.origin + part.volume * voxels;
  R* values = (R*)f.result + part.values * samples + sample;
  for (int c = 0; c < part.here; c++) {
    R sum = 0;
    UNROLL for (int n = 0; n < 8; n++) sum += weight[n] * cell.voxel(volume, n);
    *values = sum;
    volume += voxels;
    values += samples;
  }
}

// The derivative of sum(by * warped) by the maps: sums [s k warps 30], a warp's each. A numerator t and a denominator w give
// t / w, whose change is (dt - (t / w) dw) / w.
template <class R, class S> DEVICE void slopes_of(const Field& f, const Cell<R>& cell, int pair, int sample, R* slope) {
  long long voxels = size_of(f.source), samples = size_of(f.shape);
  for (int n = 0; n < f.items; n++)
    for (int c = 0; c < f.channels; c++) {
      const S* volume = (const S*)f.origin + (((long long)n * f.sources + pair / f.kinds) * f.channels + c) * voxels;
      R by = ((const R*)f.by)[(((long long)n * f.sources * f.kinds + pair) * f.channels + c) * samples + sample];
      UNROLL for (int corner = 0; corner < 8; corner++) {
        R share = by * cell.voxel(volume, corner);
        UNROLL for (int i = 0; i < 3; i++) {
          R change = share * cell.side(corner, (i + 1) % 3) * cell.side(corner, (i + 2) % 3);
          slope[i] += corner >> i & 1 ? change : -change;
        }
      }
    }
}

template <class R, class S> DEVICE void vary_maps(const Field& f) {
  int pair = blockIdx.x / f.blocks, block = blockIdx.x % f.blocks, samples = size_of(f.shape);
  double* sums = (double*)f.result + (((long long)pair * f.blocks + block) * (BLOCK / WARP) + threadIdx.x / WARP) * MAP;
  for (int first = block * BLOCK; first < samples; first += f.blocks * BLOCK) {
    int sample = first + threadIdx.x;
    Cell<R> cell(f, f.maps + (long long)pair * MAP, min(sample, samples - 1));
    R slope[3] = {0, 0, 0};
    bool counts = cell.counts && sample < samples;
    if (counts) slopes_of<R, S>(f, cell, pair, sample, slope);
    double by[5] = {0, 0, 0, 0, 0};
    UNROLL for (int i = 0; i < 3; i++) {
      by[i] = counts ? slope[i] * cell.per[i] : 0;
      by[i < 2 ? 3 : 4] -= counts ? by[i] * cell.place[i] : 0;
    }
    UNROLL for (int i = 0; i < MAP; i++) {
      double factor = (i % 3 < 2 ? cell.p[i % 3] : 1) * (i % 6 < 3 ? 1 : cell.p[2]);
      double sum = warp_sum(by[i / 6] * factor);
      if (first_of_warp()) sums[i] += sum;
    }
  }
}

// The exact transpose of a warp: a thread a voxel, which looks for the samples that read it by the inverse map. No atomics.

// The vector that is normal to three, in four dimensions.
DEVICE void normal(const double* a, const double* b, const double* c, double* out) {
  UNROLL for (int i = 0; i < 4; i++) {
    int p = (i + 1) % 4, q = (i + 2) % 4, r = (i + 3) % 4;
    double minor = a[p] * (b[q] * c[r] - b[r] * c[q]) - a[q] * (b[p] * c[r] - b[r] * c[p]) + a[r] * (b[p] * c[q] - b[q] * c[p]);
    out[i] = i % 2 ? -minor : minor;
  }
}

// The lift (a, b) of a map's samples, see `geometry/lattice.py`: of each row the growing part is b / a times the fixed one.
DEVICE bool lift_of(const double* map, double& a, double& b) {
  double greatest = 0;
  a = b = 0;
  for (int row = 0; row < 5; row++)
    for (int i = 0; i < 2; i++) {
      double fixed = map[6 * row + i], growing = map[6 * row + 3 + i], size = max(fabs(fixed), fabs(growing));
      if (size > greatest) { greatest = size; a = fixed / size; b = growing / size; }
    }
  bool whole = greatest > 0;
  for (int row = 0; row < 5; row++)
    for (int i = 0; i < 2; i++) whole = whole && fabs(map[6 * row + i] * b - map[6 * row + 3 + i] * a) <= 1e-9 * greatest;
  return whole;
}

// The inverse map of a pair: its row of index (x, y, z) is normal to R_x - x R_across, R_y - y R_across, R_z - z R_depth,
// where R are the rows of the map, as functions of the lifted index.
DEVICE void invert_maps(const Field& f) {
  long long pair = thread_of();
  if (pair >= (long long)f.sources * f.kinds) return;
  const double* map = f.maps + pair * MAP;
  float* inverse = f.inverse + pair * MAP;
  double a, b, rows[5][4], out[6][4], scale = 0;
  bool whole = lift_of(map, a, b), fixed = fabs(a) >= fabs(b);
  for (int row = 0; row < 5; row++) {
    const double* m = map + 6 * row;
    UNROLL for (int i = 0; i < 2; i++) rows[row][i] = whole ? (fixed ? m[i] / a : m[3 + i] / b) : 0;
    rows[row][2] = m[5];
    rows[row][3] = m[2];
  }
  const double *x = rows[0], *y = rows[1], *z = rows[2], *across = rows[3], *depth = rows[4];
  normal(across, y, z, out[0]);      // times -x
  normal(x, across, z, out[1]);      // times -y
  normal(x, y, z, out[2]);
  normal(across, y, depth, out[3]);  // times x z
  normal(x, across, depth, out[4]);  // times y z
  normal(x, y, depth, out[5]);       // times -z
  for (int i = 0; i < 6; i++) {
    if (i < 2 || i == 5) UNROLL for (int k = 0; k < 4; k++) out[i][k] = -out[i][k];
    scale += fabs(out[i][3]);
  }
  for (int i = 0; i < 6; i++) {
    double row[5] = {out[i][0], out[i][1], out[i][2], a * out[i][3] + b * out[i][2], out[i][3]};
    UNROLL for (int k = 0; k < 5; k++) inverse[6 * k + i] = whole && scale > 0 ? (float)(row[k] / scale) : 0;
  }
}

struct Samples { int low[3], high[3]; };  // x, y, z; the last one among them

// The samples whose cells may hold a voxel. Along x, y and z alone every place is a quotient of linear functions, so the
// greatest and the least are at corners, where the denominator has one sign.
DEVICE Samples samples_near(const Field& f, const float* map, const int* voxel) {
  float low[3], high[3];
  int ahead[2] = {0, 0}, behind[2] = {0, 0};
  for (int corner = 0; corner < 8; corner++) {
    float p[3], per[2];
    UNROLL for (int i = 0; i < 3; i++) p[i] = voxel[i] - (f.source[i] - 1) * 0.5f + (corner >> i & 1 ? 1 : -1);
    UNROLL for (int i = 0; i < 2; i++) {
      float under = value(map + ACROSS + 6 * i, p);
      ahead[i] += under > 0;
      behind[i] += under < 0;
      per[i] = inverse(under);
    }
    UNROLL for (int i = 0; i < 3; i++) {
      float place = value(map + 6 * i, p) * per[i / 2];
      low[i] = corner ? min(low[i], place) : place;
      high[i] = corner ? max(high[i], place) : place;
    }
  }
  Samples s;
  UNROLL for (int i = 0; i < 3; i++) {
    bool bounded = ahead[i / 2] == 8 || behind[i / 2] == 8;
    float centre = (f.shape[i] - 1) * 0.5f, slack = 0.02f + 1e-5f * f.shape[i], end = f.shape[i] - 1.0f;
    s.low[i] = bounded ? (int)ceil(min(max(low[i] + centre - slack, 0.0f), end + 1)) : 0;
    s.high[i] = bounded ? (int)floor(min(max(high[i] + centre + slack, -1.0f), end)) : f.shape[i] - 1;
  }
  return s;
}

// A bilinear function of samples, counted from one of them: so its digits are those of a cell.
template <class R> struct Near {
  R one, x, y, z, xz, yz;
  Near() = default;
  DEVICE Near(const double* map, const double* under, double by, const double* p) {
    double m[6];
    UNROLL for (int i = 0; i < 6; i++) m[i] = map[i] - by * under[i];
    one = (R)value(m, p);
    x = (R)(m[0] + p[2] * m[3]);
    y = (R)(m[1] + p[2] * m[4]);
    z = (R)(m[3] * p[0] + m[4] * p[1] + m[5]);
    xz = (R)m[3];
    yz = (R)m[4];
  }
};
// The same along a row of samples.
template <class R> struct Along {
  R one, x;
  DEVICE Along(const Near<R>& n, int j, int k) : one(n.one + (R)k * n.z + (R)j * (n.y + (R)k * n.yz)), x(n.x + (R)k * n.xz) {}
  DEVICE R at(int i) const { return one + (R)i * x; }
};

template <class R, class S> DEVICE void add_samples(const Field& f, const Part& part, const int* voxel, R* total) {
  const double* map = f.maps + (long long)part.pair * MAP;
  Samples s = samples_near(f, f.inverse + (long long)part.pair * MAP, voxel);
  double p[3], by[3];
  UNROLL for (int i = 0; i < 3; i++) {
    p[i] = s.low[i] - middle(f.shape[i]);
    by[i] = voxel[i] - middle(f.source[i]);
  }
  Near<R> x(map + X, map + ACROSS, by[0], p), y(map + Y, map + ACROSS, by[1], p), z(map + Z, map + DEPTH, by[2], p);
  Near<R> across(map + ACROSS, map, 0, p), depth(map + DEPTH, map, 0, p);
  int samples = size_of(f.shape);
  const S* values = (const S*)f.origin + part.values * samples;
  for (int k = s.low[2]; k <= s.high[2]; k++)
    for (int j = s.low[1]; j <= s.high[1]; j++) {
      int up = k - s.low[2], down = j - s.low[1];
      Along<R> xs(x, down, up), ys(y, down, up), zs(z, down, up), wide(across, down, up), deep(depth, down, up);
      const S* row = values + (k * f.shape[1] + j) * f.shape[0];
      for (int i = s.low[0]; i <= s.high[0]; i++) {
        int right = i - s.low[0];
        R w = wide.at(right), d = deep.at(right), per = inverse(w);
        R weight = hat(xs.at(right) * per) * hat(ys.at(right) * per) * hat(zs.at(right) * inverse(d));
        if (!(w > 0 && d > 0 && weight > 0)) continue;
        const S* value = row + i;
        UNROLL for (int c = 0; c < PLANES; c++, value += samples)
          if (c < part.here) total[c] += weight * (R)number(*value);
      }
    }
}

// Volumes [n s c d h w] from values [n s k c d h w]: blocks are of sources here, each with all of its maps.
template <class R, class S> DEVICE void gather_samples(const Field& f) {
  int voxel[3], flat = blockIdx.x % f.blocks * BLOCK + threadIdx.x, voxels = size_of(f.source);
  if (flat >= voxels) return;
  unravel(f.source, flat, voxel);
  int source = blockIdx.x / f.blocks;
  R total[PLANES] = {};
  for (int k = 0; k < f.kinds; k++) add_samples<R, S>(f, Part(f, source, k), voxel, total);
  Part part(f, source, 0);
  R* volume = (R*)f.result + part.volume * voxels + flat;
  UNROLL for (int c = 0; c < PLANES; c++)
    if (c < part.here) volume[(long long)c * voxels] = total[c];
}

#define WARP_OF(suffix, R, S, ...)                                                                                     \
  ENTRY(invert##suffix, invert_maps)                                                                                   \
  ENTRY(warp##suffix, (warp_samples<R, S>))                                                                            \
  ENTRY(warp_back##suffix, (gather_samples<R, S>))                                                                     \
  ENTRY(warp_vary##suffix, (vary_maps<R, S>))
