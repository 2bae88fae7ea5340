// The exact transpose of `look_up`: a thread a pixel, which goes along its ray slab by slab, to the voxels whose images may
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

// Where the four corners of what a pixel touches run through slabs of an axis: along axis b and c, of all four.
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

template <class R> DEVICE void show_up(const Field& f) {
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
