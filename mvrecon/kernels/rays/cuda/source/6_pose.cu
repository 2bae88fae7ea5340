// Derivatives of a ray's integral by its position, and hence by the maps of its view: `kernels/rays/cpu/trace.py`.

template <class R> struct Local { R value, slope_b, slope_c; };

// The sums over a ray's steps for the sum of volumes, each times its view; group by group.
template <class R, class T, int NV> struct Slopes {
  enum { AHEAD = 1 };
  Store<T, NV> store;
  R begin, end, slope_b, slope_c, per_b, per_c, count, step, weight[NV];
  R total, by_b, by_slope_b, by_c, by_slope_c, at_begin, at_end;
  DEVICE Slopes(const Scene& s, const Ray& ray)
      : store(s, ray.axis, 0), begin((R)ray.begin), end((R)ray.end), slope_b((R)ray.slope_b), slope_c((R)ray.slope_c),
        per_b(Line<R>(0, ray.slope_b).per()), per_c(Line<R>(0, ray.slope_c).per()), count((R)s.samples),
        step((R)((ray.end - ray.begin) / max(s.samples, 1))), total(0), by_b(0), by_slope_b(0), by_c(0), by_slope_c(0), at_begin(0), at_end(0) {}
  DEVICE R sum(const Many<T, NV>* p) const {
    Many<T, NV> many = *p;
    R value = 0;
    UNROLL for (int n = 0; n < NV; n++) value += weight[n] * number(many.n[n]);
    return value;
  }
  DEVICE Local<R> face(const Many<T, NV>* p, R y, R z) const {
    const Many<T, NV>* q = store.farther(p);
    R low = sum(p), high = sum(q), low_z = sum(p + 1) - low, high_z = sum(q + 1) - high;
    R lower = low + z * low_z, upper = high + z * high_z;
    return {lower + y * (upper - lower), upper - lower, low_z + y * (high_z - low_z)};
  }
  DEVICE void along_both(R s, R share, R along_b, R along_c) {
    by_b += share * along_b;
    by_slope_b += s * (share * along_b);
    by_c += share * along_c;
    by_slope_c += s * (share * along_c);
  }
  DEVICE void cell(int k, R s, R share, R b, R c) {
    int ib = (int)b, ic = (int)c;
    Local<R> here = face(store.at(k, ib, ic), b - (R)ib, c - (R)ic);
    total += share * here.value;
    along_both(s, share, here.slope_b, here.slope_c);
    if (s - (R)0.5 < begin) at_begin += here.value;
    if (s + (R)0.5 > end) at_end += here.value;
  }
  DEVICE void passage(int k, R s, const Passage<R>& p) {
    R first = sum(store.at(k, p.b0, p.c0)), last = sum(store.at(k, p.b1, p.c1));
    R middle = p.b_first() ? sum(store.at(k, p.b1, p.c0)) : sum(store.at(k, p.b0, p.c1));
    total += p.one() * first + (p.two() - p.one()) * middle + (p.length - p.two()) * last;
    // without a crossing both cells are the same
    R jump_b = (p.b_first() ? middle - first : last - middle) * per_b;
    R jump_c = (p.b_first() ? last - middle : middle - first) * per_c;
    by_b += jump_b;
    by_slope_b += (p.begin + p.to_b) * jump_b;
    by_c += jump_c;
    by_slope_c += (p.begin + p.to_c) * jump_c;
    if (s - (R)0.5 < begin) at_begin += first;
    if (s + (R)0.5 > end) at_end += last;
  }
  DEVICE void sample(int j, R s, int slab, R x, R b, R c) {
    int ib = (int)b, ic = (int)c;
    const Many<T, NV>* p = store.at(slab, ib, ic);
    Local<R> low = face(p, b - (R)ib, c - (R)ic), high = face(store.next_slab(p), b - (R)ib, c - (R)ic);
    R value = low.value + x * (high.value - low.value), along_b = low.slope_b + x * (high.slope_b - low.slope_b);
    R along_c = low.slope_c + x * (high.slope_c - low.slope_c), way = ((R)j + (R)0.5) / count;
    R along = high.value - low.value + slope_b * along_b + slope_c * along_c;
    total += step * value;
    along_both(s, step, along_b, along_c);
    at_begin -= step * (1 - way) * along - value / count;
    at_end += step * way * along + value / count;
  }
  // The samples of a ray move with its ends: one on a face b + s slope = constant moves with b and the slope.
  DEVICE void close(int bound, R place, R& change, R sign) {
    if (bound == OWN) return;
    R moved = sign * change;
    if (bound == FAR) {
      by_b -= moved / slope_b;
      by_slope_b -= place * moved / slope_b;
    }
    if (bound == NEAR) {
      by_c -= moved / slope_c;
      by_slope_c -= place * moved / slope_c;
    }
    change = 0;
  }
};

// The derivative by the maps of a view (kind, axis, u v 1), by comparison since an index would need local memory.
template <class R> struct Change { R by[36]; };

template <class R, class S> DEVICE void pull_back(const Scene& s, const double* line, const Ray& r, const double* p, const S& slopes, Change<R>& change) {
  double per = 1 / r.D, value_b = r.b - pick(s.sizes, r.far) * 0.5 - 0.5, value_c = r.c - pick(s.sizes, r.near) * 0.5 - 0.5;
  double sums = slopes.by_b * value_b + slopes.by_slope_b * r.slope_b + slopes.by_c * value_c + slopes.by_slope_c * r.slope_c;
  double by_D = -(sums + slopes.total) * per, begin = slopes.at_begin, end = slopes.at_end;
  // an unlimited end is never inside the box, and infinity times zero is NaN
  if (begin != 0) by_D -= begin * (r.D > 0 ? s.window[0] : s.window[1]);
  if (end != 0) by_D += end * (r.D > 0 ? s.window[1] : s.window[0]);
  double turn = (r.far + 1) % 3 == r.axis ? 1 : -1, world = r.length * r.length * r.D * r.D;
  UNROLL for (int i = 0; i < 3; i++) {
    double direction = i == r.axis ? by_D : (i == r.far ? slopes.by_slope_b : slopes.by_slope_c) * per;
    double moment = i == r.axis ? 0 : (i == r.near ? turn * slopes.by_b : -turn * slopes.by_c) * per;
    double start = i == r.axis ? end - begin : 0;
    double way = slopes.total * at(s, line, 3, i, p[0], p[1]) / world;
    UNROLL for (int k = 0; k < 3; k++) {
      double by = r.length * p[k];
      change.by[i * 3 + k] = (R)(by * direction);
      change.by[9 + i * 3 + k] = (R)(by * moment);
      change.by[18 + i * 3 + k] = (R)(by * start);
      change.by[27 + i * 3 + k] = (R)(by * way);
    }
  }
}

template <class R, class T, int NV, int METHOD> DEVICE void vary_pixel(const Scene& s, Pixel pixel, Change<R>& change) {
  Ray ray = ray_of<METHOD>(s, read_box(s), pixel);
  if (ray.first >= ray.last) return;
  long long pixels = (long long)s.n_views * s.rows * s.columns, place = index_of(s, pixel.view, pixel.v, pixel.u);
  const double* line = s.lines + (long long)pixel.view * 12 * s.maps;
  double p[3] = {pixel.u - (s.columns - 1) * 0.5, pixel.v - (s.rows - 1) * 0.5, 1};
  Slopes<R, T, NV> slopes(s, ray);
  for (int group = 0; group * NV < s.n_volumes; group++) {
    slopes.store = Store<T, NV>(s, ray.axis, group);
    UNROLL for (int n = 0; n < NV; n++)
      slopes.weight[n] = group * NV + n < s.n_volumes ? ((const R*)s.views)[(group * NV + n) * pixels + place] : (R)0;
    walk<METHOD, R>(s, ray, slopes);
  }
  if (METHOD == TRILINEAR) {
    slopes.close(ray.from, slopes.begin, slopes.at_begin, (R)-1);
    slopes.close(ray.to, slopes.end, slopes.at_end, (R)1);
  }
  pull_back(s, line, ray, p, slopes, change);
}

// Sums of the derivative of sum(views * projections), one for each warp; explicit rays have their own.
template <class R, class T, int NV, int METHOD> DEVICE void vary_rays(const Scene& s) {
  double* results = (double*)s.results;
  if (s.maps == 1) {
    long long view = thread_of();
    if (view >= s.n_views) return;
    Change<R> change = {};
    vary_pixel<R, T, NV, METHOD>(s, Pixel{(int)view, 0, 0}, change);
    UNROLL for (int i = 0; i < 12; i++) results[view * 12 + i] = change.by[i * 3 + 2];
    return;
  }
  int view = blockIdx.x / s.blocks_a_view, block = blockIdx.x % s.blocks_a_view, pixels = s.rows * s.columns;
  results += (((long long)view * s.blocks_a_view + block) * (BLOCK / WARP) + threadIdx.x / WARP) * 36;
  for (int first = block * BLOCK; first < pixels; first += s.blocks_a_view * BLOCK) {
    int i = first + threadIdx.x;
    Change<R> change = {};
    if (i < pixels) vary_pixel<R, T, NV, METHOD>(s, Pixel{view, i % s.rows, i / s.rows}, change);
    // at once, as 36 sums kept during traversal would take half of all registers
    UNROLL for (int i = 0; i < 36; i++) {
      R sum = warp_sum(change.by[i]);
      if (first_of_warp()) results[i] += sum;
    }
  }
}
