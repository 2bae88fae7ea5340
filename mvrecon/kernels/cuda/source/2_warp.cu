// Volumes [n s c d h w] through maps [s k 5 2 3] as values [n s k c d h w], trilinearly: see `warps/reference.py`.
enum { PLANES = 8, X = 0, Y = 6, Z = 12, ACROSS = 18, DEPTH = 24, MAP = 30 };  // PLANES: channels of a thread

// What a thread works on: an item n, some channels, and a source with one of its maps. A plane is a channel.
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

// Where a sample lies in its source: the eight voxels around it, and how far between them.
template <class R> struct Cell {
  bool counts;
  int at[8];  // -1: beyond the source, where all is zero
  R part[3];
  double p[3], place[3], per[3];  // about the centre; and one over what a place is divided by
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
