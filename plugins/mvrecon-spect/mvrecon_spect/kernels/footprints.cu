// Footprints of voxels behind pinholes, see `reference.py`; read behind `launch.BASE`. R is the type of arithmetic.
// Centres of voxels are projected in float64, then cast.

// Columns of a pinhole's record, as in `reference.py`.
enum { OF_W = 8, LENGTH = 12, AREA = 13, SECANT = 14, LEAST_COSINE = 20, FOOT = 21, TANGENT = 23, PER_MM = 25, HOLE = 27, WIDTH = 29 };
enum { BLUR = 41, RADIAL = 47, SHIFT = 53, EFFICIENCY = 55, RECORD = 58 };
enum { TILE = 4 };  // pixels of a thread of `project_footprints`, along u and v
#define MIDDLE (0.5 * (TILE - 1))
#define BEFORE_PLANE 0.50001  // least distance of a voxel's centre from the pinhole's plane, in depths of the voxel

// Arguments of a kernel, as in `cuda.py`.
struct Pinholes {
  const double* rig;         // records [m 58]
  const void* typed;         // the same in R
  const void* origin;        // input: volumes [n d h w] or views [n m v u]
  const void* transmission;  // [m d h w], or null
  const int* axes;           // [m]: axis across the slabs of a pinhole
  void* table;               // footprints [p d h w 8] of the pinholes at hand: centre, inverse half width, weight, power
  int* reach;                // [m slabs 2]: of the voxels of a slab, the furthest from a tile along u and v, in pixels times w; bits of float
  void* result;              // output: views [parts n m v u] or volumes [n d h w]
  int shape[3];              // voxels along x, y, z
  int detector[2];           // pixels along u, v
  int pinholes, first, here; // m, the first at hand, and how many
  int slabs, volumes, parts; // most slabs, n, parts of the slabs that blocks share
};

template <class R> DEVICE R between(R x, R low, R high) { return min(max(x, low), high); }
template <class R> DEVICE R poly(const R* c, R m, R t) { return c[0] + m * (c[1] + m * c[2]) + t * (c[3] + m * (c[4] + m * c[5])); }
DEVICE int bits_of(float x) {
#ifdef __CUDACC__
  return __float_as_int(x);
#else
  int bits;
  memcpy(&bits, &x, 4);
  return bits;
#endif
}

// The profile of a power p from 0 to 6, on [-1, 1]: between (1 - t^2)^n and (1 - t^2)^(n + 1), n <= p, the mixture of share p - n.
// By parts, its cumulative distribution less 1/2 is t (k_0 + sum of min(p - j, 1) k_j+1 (1 - t^2)^(j+1) over j < p).
enum { POWERS = 6 };
template <class R> struct Profile {
  R scale, terms[POWERS];
  DEVICE Profile(R scale, R power) : scale(scale) {
    double k = 0.5;
    UNROLL for (int j = 0; j < POWERS; j++) {
      k *= (2 * j + 1) / (2 * j + 2.0);
      terms[j] = between(power - j, (R)0, (R)1) * (R)k;
    }
  }
  DEVICE static R variance(R power) {
    R sum = (R)(1 / 3.0);
    UNROLL for (int j = 0; j < POWERS; j++) sum += between(power - j, (R)0, (R)1) * (R)(1 / (2 * j + 5.0) - 1 / (2 * j + 3.0));
    return sum;
  }
  // At a distance from the centre, in pixels.
  DEVICE R below(R distance) const {
    R t = between(distance * scale, (R)-1, (R)1), g = 1 - t * t, sum = 0;
    UNROLL for (int j = POWERS - 1; j >= 0; j--) sum = g * (sum + terms[j]);
    return t * (sum + (R)0.5);
  }
  // Of a pixel, and of a tile from that one on.
  DEVICE R share(R distance) const { return max(below(distance + (R)0.5) - below(distance - (R)0.5), (R)0); }
  DEVICE void shares(R distance, R* shares) const {
    R before = below(distance - (R)0.5);
    UNROLL for (int k = 0; k < TILE; k++) {
      R after = below(distance + (R)(k + 0.5));
      shares[k] = max(after - before, (R)0);
      before = after;
    }
  }
};

// The view of a voxel; the weight is zero, and the rest is not set, where the detector does not see it.
template <class R> struct Footprint {
  R weight, centre[2], half[2], scale[2], power[2], reach[2];
  DEVICE Footprint(const Pinholes& f, int pinhole, const int* index, long long place) : weight(0) {
    const double* map = f.rig + (long long)pinhole * RECORD;
    const R* r = (const R*)f.typed + (long long)pinhole * RECORD;
    double q[3];
    UNROLL for (int i = 0; i < 3; i++) q[i] = map[4 * i] * index[0] + map[4 * i + 1] * index[1] + map[4 * i + 2] * index[2] + map[4 * i + 3];
    if (!(-q[2] > BEFORE_PLANE * (fabs(map[OF_W]) + fabs(map[OF_W + 1]) + fabs(map[OF_W + 2])))) return;
    double over_w = 1 / q[2];
    R image[2] = {(R)(q[0] * over_w), (R)(q[1] * over_w)}, per = (R)over_w, m = -per, u = image[0], v = image[1];
    const R* c = r + SECANT;
    R cosine = inverse(sqrt(c[0] + c[1] * u + c[2] * v + c[3] * u * u + c[4] * u * v + c[5] * v * v)), t = 1 - cosine;
    bool seen = cosine >= r[LEAST_COSINE];
    UNROLL for (int i = 0; i < 2; i++) {
      R per_mm = r[PER_MM + i], tangent = (image[i] - r[FOOT + i]) * r[TANGENT + i], squares = 0, fourths = 0;
      UNROLL for (int a = 0; a < 3; a++) {
        R edge = (r[4 * i + a] - image[i] * r[OF_W + a]) * per;
        squares += edge * edge;
        fourths += edge * edge * edge * edge;
      }
      R hole = poly(r + WIDTH + 6 * i, m, t) * per_mm * per_mm;
      R blur = (poly(r + BLUR, m, t) + poly(r + RADIAL, m, t) * tangent * tangent) * per_mm * per_mm;
      R variance = squares * (R)(1 / 12.0) + hole * r[HOLE] + blur;
      R fourth = fourths * (R)(1 / 120.0) + hole * hole * r[HOLE + 1];
      R shift = (r[SHIFT] + r[SHIFT + 1] * t) * tangent * per_mm;
      power[i] = between(3 * variance * variance * inverse(fourth) - (R)2.5, (R)0, (R)POWERS);
      scale[i] = sqrt(Profile<R>::variance(power[i]) * inverse(variance));
      half[i] = inverse(scale[i]);
      centre[i] = image[i] + shift;
      reach[i] = (half[i] + fabs(shift) + (R)(TILE * 0.5)) * (R)-q[2];
      seen = seen && centre[i] + half[i] > (R)-0.5 && centre[i] - half[i] < f.detector[i] - (R)0.5;
    }
    if (!seen) return;
    const R* e = r + EFFICIENCY;
    R ratio = m * inverse(r[LENGTH]);
    weight = r[AREA] * (e[0] + t * (e[1] + t * e[2])) * cosine * cosine * cosine * ratio * ratio;
    if (f.transmission) weight *= ((const R*)f.transmission)[pinhole * (long long)size_of(f.shape) + place];
  }
};

// A thread a pinhole and voxel: its footprint, if any volume emits there.
template <class R> DEVICE void tabulate_footprints(const Pinholes& f) {
  long long at = thread_of(), voxels = size_of(f.shape), place = at % voxels;
  int pinhole = f.first + (int)(at / voxels), index[3];
  if (at >= f.here * voxels) return;
  unravel(f.shape, (int)place, index);
  bool emits = false;
  for (int n = 0; n < f.volumes; n++) emits = emits || ((const R*)f.origin)[n * voxels + place] != 0;
  Quad<R>* entry = (Quad<R>*)f.table + 2 * at;
  entry[0] = {(R)1e30, (R)1e30, 1, 1};
  if (!emits) return;
  Footprint<R> own(f, pinhole, index, place);
  if (own.weight == 0) return;
  entry[0] = {own.centre[0], own.centre[1], own.scale[0], own.scale[1]};
  entry[1] = {own.weight, own.power[0], own.power[1], 0};
  int* furthest = f.reach + 2 * ((long long)pinhole * f.slabs + pick(index, f.axes[pinhole]));
  UNROLL for (int i = 0; i < 2; i++) {
    int bits = bits_of((float)own.reach[i] * 1.00001f);  // of positive numbers, in their order
    if (furthest[i] < bits) add_greatest(furthest + i, bits);
  }
}

// The voxels that reach a tile of pixels: those with |(U - u W) x| and |(V - v W) x| up to the reach of their slab, in a slab a
// parallelogram; along one of its axes from + slab by, plus or minus u and v times the reach.
struct Extent {
  float from, by, u, v;
  DEVICE void range(int slab, const float* reach, int size, int& first, int& last) const {
    float centre = from + slab * by, half = u * reach[0] + v * reach[1] + 0.01f + 1e-6f * (fabs(from) + fabs(slab * by));
    first = (int)ceil(between(centre - half, 0.0f, (float)size));
    last = (int)floor(between(centre + half, -1.0f, size - 1.0f));
  }
};

struct Beam {
  Extent along_b, along_c;
  DEVICE Beam(const double* map, double column, double row, int axis, int b, int c) {
    double u[4], v[4];
    UNROLL for (int i = 0; i < 4; i++) {
      u[i] = map[i] - column * map[OF_W + i];
      v[i] = map[4 + i] - row * map[OF_W + i];
    }
    double ua = pick(u, axis), ub = pick(u, b), uc = pick(u, c), va = pick(v, axis), vb = pick(v, b), vc = pick(v, c);
    double across = ub * vc - uc * vb, per = 1 / across;
    along_b = {(float)((v[3] * uc - u[3] * vc) * per), (float)((va * uc - ua * vc) * per), (float)fabs(vc * per), (float)fabs(uc * per)};
    along_c = {(float)((u[3] * vb - v[3] * ub) * per), (float)((ua * vb - va * ub) * per), (float)fabs(vb * per), (float)fabs(ub * per)};
    // a ray along the slabs, in which it may be anywhere
    if (!(fabs(across) > 1e-9 * (fabs(ub) + fabs(uc)) * (fabs(vb) + fabs(vc)))) along_b = along_c = {0, 0, 1e30f, 1e30f};
  }
};

// A thread a tile of pixels, of a part of the slabs: the sums over the voxels that reach it.
template <class R> DEVICE void project_footprints(const Pinholes& f) {
  int width = f.detector[0], height = f.detector[1], wide = (width + TILE - 1) / TILE, tall = (height + TILE - 1) / TILE;
  long long at = thread_of(), threads = (long long)wide * tall, voxels = size_of(f.shape), plane = voxels / f.shape[2];
  if (at >= f.here * threads) return;
  int own = (int)(at / threads), pinhole = f.first + own, column = (int)(at % wide) * TILE, row = (int)(at % threads / wide) * TILE;
  int axis = f.axes[pinhole], b = axis == 0 ? 1 : 0, c = axis == 2 ? 1 : 2;
  Beam beam(f.rig + (long long)pinhole * RECORD, column + MIDDLE, row + MIDDLE, axis, b, c);
  long long step = axis == 0 ? 1 : axis == 1 ? f.shape[0] : plane, step_b = b == 0 ? 1 : f.shape[0], step_c = c == 1 ? f.shape[0] : plane;
  const Quad<R>* table = (const Quad<R>*)f.table + 2 * own * voxels;
  const R* volume = (const R*)f.origin + blockIdx.y % f.volumes * voxels;
  int part = blockIdx.y / f.volumes, slabs = pick(f.shape, axis);
  R total[TILE][TILE] = {};
  for (int slab = (int)((long long)slabs * part / f.parts); slab < (int)((long long)slabs * (part + 1) / f.parts); slab++) {
    const float* reach = (const float*)f.reach + 2 * ((long long)pinhole * f.slabs + slab);
    if (reach[0] == 0) continue;  // nothing is seen
    int first_b, last_b, first_c, last_c;
    beam.along_b.range(slab, reach, pick(f.shape, b), first_b, last_b);
    beam.along_c.range(slab, reach, pick(f.shape, c), first_c, last_c);
    R sum[TILE][TILE] = {};
    for (int j = first_c; j <= last_c; j++)
      for (int i = first_b; i <= last_b; i++) {
        long long place = slab * step + j * step_c + i * step_b;
        R x = volume[place];
        if (x == 0) continue;
        Quad<R> where = table[2 * place];
        R u = column - where.a, v = row - where.b;
        if (!((fabs(u + (R)MIDDLE) - (R)(TILE * 0.5)) * where.c < 1 && (fabs(v + (R)MIDDLE) - (R)(TILE * 0.5)) * where.d < 1)) continue;
        Quad<R> how = table[2 * place + 1];
        R across[TILE], down[TILE];
        Profile<R>(where.c, how.b).shares(u, across);
        Profile<R>(where.d, how.c).shares(v, down);
        UNROLL for (int k = 0; k < TILE; k++)
          UNROLL for (int l = 0; l < TILE; l++) {
            R share = how.a * down[k] * across[l];
            if (share != 0) sum[k][l] += x * share;  // x may not be finite
          }
      }
    UNROLL for (int k = 0; k < TILE * TILE; k++) total[k / TILE][k % TILE] += sum[k / TILE][k % TILE];
  }
  R* view = (R*)f.result + (((long long)blockIdx.y * f.pinholes + pinhole) * height + row) * width + column;
  UNROLL for (int k = 0; k < TILE * TILE; k++)
    if (row + k / TILE < height && column + k % TILE < width) view[(long long)(k / TILE) * width + k % TILE] = total[k / TILE][k % TILE];
}

// A thread a voxel: the sum over the pixels under its footprints.
template <class R> DEVICE void backproject_footprints(const Pinholes& f) {
  long long at = thread_of(), pixels = (long long)f.detector[0] * f.detector[1], voxels = size_of(f.shape);
  if (at >= voxels) return;
  int index[3];
  unravel(f.shape, (int)at, index);
  const R* view = (const R*)f.origin + (long long)blockIdx.y * f.pinholes * pixels;
  R total = 0;
  for (int pinhole = 0; pinhole < f.pinholes; pinhole++, view += pixels) {
    Footprint<R> own(f, pinhole, index, at);
    if (own.weight == 0) continue;
    int first[2], last[2];
    UNROLL for (int i = 0; i < 2; i++) {
      first[i] = (int)floor(max(own.centre[i] - own.half[i] + (R)0.5, (R)0));
      last[i] = (int)floor(min(own.centre[i] + own.half[i] + (R)0.5, f.detector[i] - (R)1));
    }
    Profile<R> across(own.scale[0], own.power[0]), down(own.scale[1], own.power[1]);
    R sum = 0;
    for (int row = first[1]; row <= last[1]; row++) {
      R share = down.share(row - own.centre[1]), line = 0;
      R before = across.below(first[0] - (R)0.5 - own.centre[0]);
      for (int column = first[0]; column <= last[0]; column++) {
        R after = across.below(column + (R)0.5 - own.centre[0]), weight = share * max(after - before, (R)0);
        if (weight > 0) line += weight * view[(long long)row * f.detector[0] + column];
        before = after;
      }
      sum += line;
    }
    total += own.weight * sum;
  }
  ((R*)f.result)[blockIdx.y * voxels + at] = total;
}

#define FOOTPRINT(name, kernel) extern "C" __global__ void __launch_bounds__(BLOCK) name(const Pinholes f) { kernel(f); }
#define FOOTPRINTS_OF(suffix, R, ...)                                  \
  FOOTPRINT(footprint_table##suffix, tabulate_footprints<R>)           \
  FOOTPRINT(footprint_project##suffix, project_footprints<R>)          \
  FOOTPRINT(footprint_backproject##suffix, backproject_footprints<R>)
