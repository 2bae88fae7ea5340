// Footprints of bricks, a thread a brick: which are proved empty (the visual hull), and the counts in them; see `visual_hull/footprints.py` and `hull.py`.
// A view has 17 numbers: the map [3 4] from voxels about the centre to (u w, v w, w), parallel beams to (u, v, w), the margin
// to a ray (u, v), its share of the ray, and the further growth of footprints (u, v).
enum { PRINT = 17 };
#define ROUNDING 1e-3

// Numbers as sums of two floats, 48 binary digits, where float64 is slow: T. J. Dekker, Numer. Math. 18 (1971) 224.
struct Twofold { float high, low; };

// A product rounded on its own, not fused with a sum.
DEVICE float times(float a, float b) {
#ifdef __CUDACC__
  return __fmul_rn(a, b);
#else
  return a * b;
#endif
}

DEVICE Twofold twofold(double x) { return {(float)x, (float)(x - (float)x)}; }
DEVICE double wide(Twofold x) { return (double)x.high + x.low; }
// Of two numbers of which the first is the greater.
DEVICE Twofold joined(float high, float low) {
  float sum = high + low;
  return {sum, low - (sum - high)};
}
DEVICE Twofold operator-(Twofold x) { return {-x.high, -x.low}; }
DEVICE Twofold operator+(Twofold a, Twofold b) {
  float sum = a.high + b.high, part = sum - a.high;
  return joined(sum, (a.high - (sum - part)) + (b.high - part) + (a.low + b.low));
}
DEVICE Twofold operator*(Twofold a, Twofold b) {
  float high = times(a.high, b.high);
  return joined(high, fma(a.high, b.high, -high) + (a.high * b.low + a.low * b.high));
}
DEVICE Twofold operator/(Twofold a, Twofold b) {
  float per = inverse(b.high), first = times(a.high, per);
  Twofold rest = a + -(b * Twofold{first, 0});
  return joined(first, rest.high * per);
}
DEVICE bool operator<(Twofold a, Twofold b) { return a.high < b.high || (a.high == b.high && a.low < b.low); }

struct Print {
  int low[2], high[2];
  bool whole;  // the whole brick is visible
  DEVICE Print(const Field& f, const double* view, const Twofold* near, const Twofold* far) : whole(true) {
    Twofold map[12], ends[2][3];
    UNROLL for (int i = 0; i < 12; i++) map[i] = twofold(view[i]);
    for (int corner = 0; corner < 8; corner++) {
      Twofold q[3], x = corner & 1 ? far[0] : near[0], y = corner & 2 ? far[1] : near[1], z = corner & 4 ? far[2] : near[2];
      UNROLL for (int i = 0; i < 3; i++) q[i] = map[4 * i] * x + map[4 * i + 1] * y + map[4 * i + 2] * z + map[4 * i + 3];
      UNROLL for (int i = 0; i < 3; i++) {
        Twofold place = i < 2 && !f.parallel ? q[i] / q[2] : q[i];
        if (!corner || place < ends[0][i]) ends[0][i] = place;
        if (!corner || ends[1][i] < place) ends[1][i] = place;
      }
    }
    double least[3], greatest[3];
    UNROLL for (int i = 0; i < 3; i++) {
      least[i] = wide(ends[0][i]);
      greatest[i] = wide(ends[1][i]);
    }
    // the image may be anywhere
    bool across = least[2] <= 0 && greatest[2] >= 0 && !f.parallel;
    bool unseen = greatest[2] <= f.window[0] || least[2] >= f.window[1];
    whole = !across && least[2] >= f.window[0] + view[14] && greatest[2] <= f.window[1] - view[14];
    UNROLL for (int i = 0; i < 2; i++) {
      double a = least[i] - view[12 + i] - ROUNDING, b = greatest[i] + view[12 + i] + ROUNDING, size = f.source[i];
      whole = whole && a > -1 && b < size;
      low[i] = across ? 0 : (int)min(max(ceil(a - view[15 + i]), 0.0), size);
      high[i] = across ? (int)size : (int)min(floor(max(b + view[15 + i], -2.0)) + 1, size);
      high[i] = unseen ? low[i] : max(low[i], high[i]);
    }
  }
};

// The corners of a brick's voxels, from the grid's centre.
struct Corners {
  Twofold near[3], far[3];
  DEVICE Corners(const Field& f, int flat) {
    int brick[3];
    unravel(f.shape, flat, brick);
    UNROLL for (int i = 0; i < 3; i++) {
      int voxels = f.voxels[i], low = brick[i] * f.edge;
      near[i] = twofold(low - (middle(voxels) + 0.5) - f.reach);
      far[i] = twofold(min(low + f.edge, voxels) - (middle(voxels) + 0.5) + f.reach);
    }
  }
};

// The sum over a footprint, from a table of so many columns.
DEVICE int sum_over(const Print& p, const int* table, int width) {
  const int *above = table + (long long)p.low[1] * width, *below = table + (long long)p.high[1] * width;
  return below[p.high[0]] - above[p.high[0]] - below[p.low[0]] + above[p.low[0]];
}

// Into kept [b z y x]: whether fewer views than enough prove a brick empty. From tables [b m v+1 u+1] of the foreground
// pixels above and left of a corner.
DEVICE void keep_bricks(const Field& f) {
  long long at = thread_of(), bricks = size_of(f.shape);
  if (at >= bricks) return;
  Corners brick(f, (int)at);
  int width = f.source[0] + 1, empty = 0;
  long long corners = (long long)width * (f.source[1] + 1);
  const int* table = (const int*)f.origin + (long long)blockIdx.y * f.kinds * corners;
  bool dark = true;
  for (int m = 0; m < f.kinds && empty < f.enough; m++, table += corners) {
    Print p(f, f.maps + (long long)m * PRINT, brick.near, brick.far);
    bool none = sum_over(p, table, width) == 0;
    empty += none && p.whole;
    dark = dark && none;
  }
  ((unsigned char*)f.result)[blockIdx.y * bricks + at] = empty < f.enough && (f.keep_unseen || !dark);
}

#define HULL_OF(suffix, ...) ENTRY(kept_bricks##suffix, keep_bricks)
