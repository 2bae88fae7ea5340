// The exact transpose: voxel by voxel for cameras, deterministic; ray by ray, with atomic additions, for explicit rays.

// Records of four numbers for a ray.
template <int METHOD> constexpr int QUADS = METHOD == SIDDON ? 3 : 2;

// Records for the gather of the rays of the views first_view, first_view + 1, ..; a thread a pixel.
template <class R, int NV, int METHOD> DEVICE void record_rays(const Scene& s) {
  long long pixel = thread_of(), pixels = (long long)s.views_here * s.rows * s.columns;
  if (pixel >= pixels) return;
  int u = (int)(pixel % s.columns), v = (int)(pixel / s.columns % s.rows), view = (int)(pixel / ((long long)s.columns * s.rows));
  Pixel p = {s.first_view + view, v, u};
  Ray ray = ray_of<METHOD>(s, stored_box(s), p);
  bool hit = ray.first < ray.last;
  Many<R, NV> value;
  long long all = (long long)s.n_views * s.rows * s.columns, place = index_of(s, p.view, v, u);
  UNROLL for (int n = 0; n < NV; n++) {
    int volume = blockIdx.y * NV + n;
    value.n[n] = hit && volume < s.n_volumes ? (R)ray.length * ((const R*)s.views)[volume * all + place] : (R)0;
  }
  ((Many<R, NV>*)s.values)[blockIdx.y * pixels + pixel] = value;
  if (blockIdx.y) return;
  Quad<R>* kept = (Quad<R>*)s.rays + pixel * QUADS<METHOD>;
  Course<R> course(ray);
  if constexpr (METHOD == SIDDON) {
    Line<R> b(ray.b + 0.5, ray.slope_b), c(ray.c + 0.5, ray.slope_c);
    kept[0] = {b.whole, b.part, b.slope, b.rest};
    kept[1] = {c.whole, c.part, c.slope, c.rest};
    kept[2] = {course.begin, course.end, b.per(), c.per()};
  } else {
    // the hat functions of a ray that misses are zero at every voxel
    R step = (R)((ray.end - ray.begin) / max(s.samples, 1));
    kept[0] = {hit ? course.b : (R)-1e9, course.slope_b, hit ? course.c : (R)-1e9, course.slope_c};
    kept[1] = {course.begin, course.end, step, 1 / step};
  }
  s.axes[pixel] = hit ? ray.axis : NONE;
  if (!hit) return;
  double half = pick(s.sizes, ray.axis) * 0.5;
  int bits = 1 << ray.axis | (ray.begin > -half || ray.end < half ? SHORT : 0);
  int* flags = s.flags + 1 + p.view;
  if ((*flags & bits) != bits) add_bits(flags, bits);
}

// The weight of a ray in a voxel, in slabs, as in the method's traversal. b and c count the voxel from the
// border along far and near axis; s is its slab.
template <class R, int METHOD> struct Weight {
  int samples;
  DEVICE R operator()(const Quad<R>* ray, R s, int b, int c) const {
    if constexpr (METHOD == SIDDON) {
      Quad<R> ends = ray[2];
      R s0 = max(ends.a, s - (R)0.5), s1 = min(ends.b, s + (R)0.5);
      if (!(s1 > s0)) return 0;
      Line<R> far = line(ray[0]), near = line(ray[1]);
      Passage<R> p = between(far.at(s0), far.at(s1), near.at(s0), near.at(s1), ends.c, ends.d, s0, s1 - s0);
      R weight = b == p.b0 && c == p.c0 ? p.one() : (R)0;
      if (b == (p.b_first() ? p.b1 : p.b0) && c == (p.b_first() ? p.c0 : p.c1)) weight += p.two() - p.one();
      return b == p.b1 && c == p.c1 ? weight + (p.length - p.two()) : weight;
    } else if constexpr (METHOD == JOSEPH) {
      Quad<R> line = ray[0], ends = ray[1];
      R share = max((R)0, overlap(ends.a, ends.b, s));
      return share * hat(line.a + s * line.b - (R)b) * hat(line.c + s * line.d - (R)c);
    } else {
      return of_samples(ray[0], ray[1], s, b, c);
    }
  }
  DEVICE static Line<R> line(const Quad<R>& kept) {
    Line<R> l;
    l.whole = kept.a; l.part = kept.b; l.slope = kept.c; l.rest = kept.d;
    return l;
  }
  DEVICE R of_samples(const Quad<R>& line, const Quad<R>& ends, R s, int b, int c) const {
    // one more sample on either side, for rounding: its hat is zero
    R low = (s - 1 - ends.a) * ends.d - (R)1.5, high = (s + 1 - ends.a) * ends.d + (R)0.5;
    int first = (int)min(max(ceil(low), (R)0), (R)samples), last = (int)max(min(floor(high), (R)(samples - 1)), (R)-1);
    R weight = 0;
    for (int j = first; j <= last; j++) {
      R at = ends.a + ((R)j + (R)0.5) * ends.c;
      weight += hat(at - s) * hat(line.a + at * line.b - (R)b) * hat(line.c + at * line.d - (R)c);
    }
    return weight * ends.c;
  }
};

struct Pixels { int u0, u1, v0, v1; };
// The pixels whose rays can touch a voxel: u is a quotient, so for a point within `reach` of X it differs by at most
// sum reach_i |P_i - u W_i| / (|W| - sum reach_i |W_i|).
DEVICE Pixels pixels_near(const Scene& s, const float* P, const float* X, const float* reach) {
  float U = P[3], V = P[7], W = P[11], less = 0;
  UNROLL for (int i = 0; i < 3; i++) {
    U += P[i] * X[i]; V += P[4 + i] * X[i]; W += P[8 + i] * X[i];
    less += reach[i] * fabs(P[8 + i]);
  }
  Pixels p = {0, s.columns - 1, 0, s.rows - 1};
  // on both sides of the source, or near it, the image is unbounded: every pixel
  if (!(fabs(W) - less > 0.02f * fabs(W))) return p;
  float per = 1 / W, u = U * per, v = V * per, du = 0, dv = 0;
  UNROLL for (int i = 0; i < 3; i++) {
    du += reach[i] * fabs(P[i] - u * P[8 + i]);
    dv += reach[i] * fabs(P[4 + i] - v * P[8 + i]);
  }
  // margin of the image for rounding
  float wider = 1.01f / (fabs(W) - less), slack = 0.02f + 1e-5f * max(s.columns, s.rows);
  du = du * wider + slack;
  dv = dv * wider + slack;
  float cu = (s.columns - 1) * 0.5f, cv = (s.rows - 1) * 0.5f;
  p.u0 = (int)ceil(min(max(u - du + cu, 0.0f), (float)s.columns));
  p.u1 = (int)floor(max(min(u + du + cu, s.columns - 1.0f), -1.0f));
  p.v0 = (int)ceil(min(max(v - dv + cv, 0.0f), (float)s.rows));
  p.v1 = (int)floor(max(min(v + dv + cv, s.rows - 1.0f), -1.0f));
  return p;
}

// Add one view's contribution to a voxel. AXIS: of Joseph's rays; WHOLE: all of them are of this axis, and end outside.
template <class R, int NV, int METHOD, bool WHOLE> struct Collector {
  const Scene& s;
  const Many<R, NV>* values;
  const int* voxel;  // x, y, z
  R* total;
  DEVICE void operator()(const float* P, long long start, const float* X, int wanted) const {
    int near = wanted == 2 ? 0 : 2, far = 3 - wanted - near;
    float reach[3];
    UNROLL for (int i = 0; i < 3; i++)
      reach[i] = METHOD == SIDDON ? 0.5f : METHOD == JOSEPH && i == wanted ? 0.0f : 1.0f;
    Pixels p = pixels_near(s, P, X, reach);
    R slab = (R)pick(voxel, wanted) - (R)(pick(s.sizes, wanted) - 1) * (R)0.5;
    int b = pick(voxel, far) + 1, c = pick(voxel, near) + 1;
    const Quad<R>* rays = (const Quad<R>*)s.rays;
    for (int v = p.v0; v <= p.v1; v++)
      for (int u = p.u0; u <= p.u1; u++) {
        long long k = start + (long long)v * s.columns + u;
        R weight;
        if constexpr (WHOLE) {
          Quad<R> line = rays[k * QUADS<METHOD>];
          weight = hat(line.a + slab * line.b - (R)b) * hat(line.c + slab * line.d - (R)c);
        } else {
          if (s.axes[k] != wanted) continue;
          weight = Weight<R, METHOD>{s.samples}(rays + k * QUADS<METHOD>, slab, b, c);
        }
        Many<R, NV> value = values[k];
        UNROLL for (int n = 0; n < NV; n++) total[n] += weight * value.n[n];
      }
  }
};

template <class R, int NV, int METHOD> DEVICE void gather_voxels(const Scene& s) {
  long long size = (long long)s.part[0] * s.part[1] * s.part[2], at = thread_of(), pixels = (long long)s.rows * s.columns;
  if (at >= size) return;
  int voxel[3] = {(int)(at % s.part[0]) + s.corner[0], (int)(at / s.part[0] % s.part[1]) + s.corner[1],
                  (int)(at / ((long long)s.part[0] * s.part[1])) + s.corner[2]};
  float X[3];
  UNROLL for (int i = 0; i < 3; i++) X[i] = voxel[i] - (s.sizes[i] - 1) * 0.5f;
  R total[NV];
  UNROLL for (int n = 0; n < NV; n++) total[n] = 0;
  const Many<R, NV>* values = (const Many<R, NV>*)s.values + blockIdx.y * s.views_here * pixels;
  Collector<R, NV, METHOD, false> some{s, values, voxel, total};
  Collector<R, NV, METHOD, METHOD == JOSEPH> all{s, values, voxel, total};
  for (int m = 0; m < s.views_here; m++) {
    int flags = s.flags[1 + s.first_view + m];
    const float* P = s.frames + (s.first_view + m) * 12;
    if (METHOD == JOSEPH && flags == 1) all(P, m * pixels, X, 0);
    else if (METHOD == JOSEPH && flags == 2) all(P, m * pixels, X, 1);
    else
      for (int axis = 0; axis < 3; axis++)
        if (flags >> axis & 1) some(P, m * pixels, X, axis);
  }
  R* results = (R*)s.results;
  UNROLL for (int n = 0; n < NV; n++) {
    int volume = blockIdx.y * NV + n;
    if (volume < s.n_volumes) results[volume * size + at] = (s.first_view ? results[volume * size + at] : (R)0) + total[n];
  }
}

template <class R, int NV> struct Spread {
  enum { AHEAD = 1 };
  const Scene& s;
  int axis, far, near, group;
  R step, value[NV];
  DEVICE void to(int k, int b, int c, R weight) {
    int place[3];
    UNROLL for (int i = 0; i < 3; i++) place[i] = (i == axis ? k : i == far ? b - 1 : c - 1) - s.corner[i];
    UNROLL for (int i = 0; i < 3; i++) if (place[i] < 0 || place[i] >= s.part[i]) return;
    long long size = (long long)s.part[0] * s.part[1] * s.part[2], voxel = ((long long)place[2] * s.part[1] + place[1]) * s.part[0] + place[0];
    UNROLL for (int n = 0; n < NV; n++)
      if (group * NV + n < s.n_volumes) add((R*)s.results + (group * NV + n) * size + voxel, weight * value[n]);
  }
  DEVICE void cell(int k, R, R share, R b, R c) {
    int ib = (int)b, ic = (int)c;
    R y = b - (R)ib, z = c - (R)ic;
    to(k, ib, ic, share * (1 - y) * (1 - z));
    to(k, ib, ic + 1, share * (1 - y) * z);
    to(k, ib + 1, ic, share * y * (1 - z));
    to(k, ib + 1, ic + 1, share * y * z);
  }
  DEVICE void sample(int, R s, int slab, R x, R b, R c) {
    cell(slab, s, step * (1 - x), b, c);
    cell(slab + 1, s, step * x, b, c);
  }
  DEVICE void passage(int k, R, const Passage<R>& p) {
    to(k, p.b0, p.c0, p.one());
    to(k, p.b_first() ? p.b1 : p.b0, p.b_first() ? p.c0 : p.c1, p.two() - p.one());
    to(k, p.b1, p.c1, p.length - p.two());
  }
};

template <class R, int NV, int METHOD> DEVICE void scatter_rays(const Scene& s) {
  Pixel p = pixel_of(s);
  if (!on_detector(s, p)) return;
  Ray ray = ray_of<METHOD>(s, stored_box(s), p);
  Spread<R, NV> spread{s, ray.axis, ray.far, ray.near, (int)blockIdx.y, (R)((ray.end - ray.begin) / max(s.samples, 1)), {}};
  long long pixels = (long long)s.n_views * s.rows * s.columns, pixel = index_of(s, p.view, p.v, p.u);
  UNROLL for (int n = 0; n < NV; n++) {
    int volume = blockIdx.y * NV + n;
    spread.value[n] = volume < s.n_volumes ? (R)ray.length * ((const R*)s.views)[volume * pixels + pixel] : (R)0;
  }
  walk<METHOD, R>(s, ray, spread);
}
