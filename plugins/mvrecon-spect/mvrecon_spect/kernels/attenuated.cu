// Attenuated rays, read behind the files of `mvrecon/kernels/rays/cuda/source`: the last of the volumes that are stored is mu. As `reference.py`: a segment, a
// slab for Joseph's method and a cell for Siddon's, of the optical depth m sends out exp(-A) (1 - exp(-m)) / m of its
// emission, A the depth of those between it and the end of the ray where w is greatest.
// Distance-driven rays (AREA) are those of `distance_driven.py`.
// A walk goes up the slabs; where the detector stands beyond the last, A is what all have less what has been passed.

struct AttenuatedScene : Scene {
  const double* layers;  // [m k]
  double fixed;          // by which numbers are multiplied to be whole
  int n_layers;
};

enum { AREA = 3 };

#ifdef __CUDACC__
DEVICE void add_whole(long long* to, long long value) { atomicAdd((unsigned long long*)to, (unsigned long long)value); }
#else
DEVICE void add_whole(long long* to, long long value) { *to += value; }
#endif

// A sum that loses no digit to its length (Kahan).
template <class R> struct Compensated {
  R value, lost;
  DEVICE Compensated() : value(0), lost(0) {}
  DEVICE void operator+=(R more) {
    R y = more - lost, sum = value + y;
    lost = (sum - value) - y;
    value = sum;
  }
};

// (1 - exp(-m)) / m; up to m = 1/2 its series, whose terms that are left out are below the last digit.
template <class R> DEVICE R mean_passed(R m) {
  if (m > (R)0.5) return -expm1(-m) / m;
  const int terms = sizeof(R) == 4 ? 8 : 14;
  R sum = 1;
  UNROLL for (int k = terms; k > 1; k--) sum = 1 - m * sum * (R)(1.0 / k);
  return sum;
}

// Its derivative.
template <class R> DEVICE R slope_of_mean(R m) {
  if (m > (R)0.5) return (exp(-m) * (1 + m) - 1) / (m * m);
  const int terms = sizeof(R) == 4 ? 9 : 14;
  R sum = 1;
  UNROLL for (int k = terms; k > 2; k--) sum = 1 - m * sum * (R)((k - 1.0) / (k * (k - 2.0)));
  return (R)-0.5 * sum;
}

// The part of a ray in one segment: bilinear in the cell (b, c) of slab k, or that cell alone, of so many mm.
template <class R, int METHOD> struct Segment {
  int k, b, c;
  R y, z, length;
  DEVICE R of(const Store<R, 1>& store) const {
    const Many<R, 1>* p = store.at(k, b, c);
    if constexpr (METHOD == SIDDON) return length * p->n[0];
    const Many<R, 1>* q = store.farther(p);
    R lower = p[0].n[0] + z * (p[1].n[0] - p[0].n[0]), upper = q[0].n[0] + z * (q[1].n[0] - q[0].n[0]);
    return length * (lower + y * (upper - lower));
  }
};

// The voxels from `low` on, before `high`, that a footprint covers along an axis, and the part of it in each.
template <class R> struct Covered {
  int low, high;
  R start, per;
  DEVICE Covered(R middle, R side, int size) : start(middle + (R)0.5 - (R)0.5 * side), per(1 / side) {
    low = max((int)floor(start), 1);
    high = min((int)floor(start + side) + 2, size + 1);
  }
  DEVICE R part(int voxel) const {
    R below = min(max(((R)voxel - start) * per, (R)0), (R)1);
    return min(max(((R)(voxel + 1) - start) * per, (R)0), (R)1) - below;
  }
};

// The mean over a footprint in slab k.
template <class R> struct Segment<R, AREA> {
  int k;
  Covered<R> b, c;
  R length;
  DEVICE R of(const Store<R, 1>& store) const {
    R sum = 0;
    for (int i = b.low; i < b.high; i++) {
      R row = 0;
      for (int j = c.low; j < c.high; j++) row += c.part(j) * store.at(k, i, j)->n[0];
      sum += b.part(i) * row;
    }
    return length * sum;
  }
};

// A ray with the sides of its footprints, |start + s rate| voxels; one for a line.
template <int METHOD> struct Beam : Ray {
  DEVICE Beam(const Scene& s, Pixel p) : Ray(ray_of<METHOD>(s, stored_box(s), p)) {}
};

template <> struct Beam<AREA> : Ray {
  double start_b, rate_b, start_c, rate_c;
  DEVICE Beam(const Scene& s, Pixel p) {
    const double* line = s.lines + (long long)p.view * 12 * s.maps;
    double u = p.u - (s.columns - 1) * 0.5, v = p.v - (s.rows - 1) * 0.5;
    int a = main_axis(s, line, 0, 0), own = main_axis(s, line, u, v);
    if (fabs(at(s, line, 0, own, u, v)) > 5 * fabs(at(s, line, 0, a, u, v))) a = own;
    int near_axis = a == 2 ? 0 : 2, far_axis = 3 - a - near_axis;
    bool parallel = true;
    UNROLL for (int i = 0; i < 3; i++) parallel = parallel && line[i * 3] == 0 && line[i * 3 + 1] == 0;
    const double *steps = line + (parallel ? 18 : 0), *main = steps + a * 3, *of_b = steps + far_axis * 3, *of_c = steps + near_axis * 3;
    double per = 1 / at(s, line, 0, a, u, v), slope_of_b = at(s, line, 0, far_axis, u, v) * per, slope_of_c = at(s, line, 0, near_axis, u, v) * per;
    // images of the steps between columns and between rows, for cones per slab from the source
    double column_b = of_b[0] - slope_of_b * main[0], column_c = of_c[0] - slope_of_c * main[0];
    double row_b = of_b[1] - slope_of_b * main[1], row_c = of_c[1] - slope_of_c * main[1];
    double wide = max(fabs(column_b), fabs(row_b)), high = max(fabs(column_c), fabs(row_c));
    double scale = wide * high > 0 ? sqrt(fabs(column_b * row_c - column_c * row_b) / (wide * high)) : 1;
    double from_source = parallel ? 0 : per, source = at(s, line, 2, a, u, v);
    rate_b = wide * scale * from_source;
    rate_c = high * scale * from_source;
    start_b = parallel ? wide * scale : -source * rate_b;
    start_c = parallel ? high * scale : -source * rate_c;
    Box box = stored_box(s);
    double half = pick(s.sizes, a) * 0.5;
    int grow_b = (int)ceil(0.5 * max(side(start_b, rate_b, -half), side(start_b, rate_b, half)));
    int grow_c = (int)ceil(0.5 * max(side(start_c, rate_c, -half), side(start_c, rate_c, half)));
    UNROLL for (int i = 0; i < 3; i++) {
      int grow = i == far_axis ? grow_b : i == near_axis ? grow_c : 0;
      box.low[i] -= grow;
      box.high[i] += grow;
    }
    (Ray&)*this = trace<JOSEPH>(s, box, line, u, v, a);
  }
  template <class R> DEVICE static R side(R start, R rate, R at) { return max((R)fabs(start + at * rate), (R)0.1); }
};

// Hands the segments of a ray, with their optical depths and s, to a visitor.
template <class R, int METHOD, class V> struct Segments {
  enum { AHEAD = 1 };
  Store<R, 1> matter;
  R length;
  V visitor;
  DEVICE Segments(const Scene& s, const Beam<METHOD>& ray, const V& visitor)
      : matter(s, ray.axis, s.n_volumes - 1), length((R)ray.length), visitor(visitor) {}
  DEVICE void one(const Segment<R, METHOD>& segment, R s) { visitor.segment(segment, segment.of(matter), s); }
  DEVICE void cell(int k, R s, R share, R b, R c) {
    int ib = (int)b, ic = (int)c;
    one({k, ib, ic, b - (R)ib, c - (R)ic, length * share}, s);
  }
  DEVICE void passage(int k, R s, const Passage<R>& p) {
    one({k, p.b0, p.c0, 0, 0, length * p.one()}, s);
    one({k, p.b_first() ? p.b1 : p.b0, p.b_first() ? p.c0 : p.c1, 0, 0, length * (p.two() - p.one())}, s);
    one({k, p.b1, p.c1, 0, 0, length * (p.length - p.two())}, s);
  }
};

template <class R, class V> struct Segments<R, AREA, V> {
  enum { AHEAD = 1 };
  Store<R, 1> matter;
  R length, start_b, rate_b, start_c, rate_c;
  int size_b, size_c;
  V visitor;
  DEVICE Segments(const Scene& s, const Beam<AREA>& ray, const V& visitor)
      : matter(s, ray.axis, s.n_volumes - 1), length((R)ray.length), start_b((R)ray.start_b), rate_b((R)ray.rate_b),
        start_c((R)ray.start_c), rate_c((R)ray.rate_c), size_b(pick(s.sizes, ray.far)), size_c(pick(s.sizes, ray.near)), visitor(visitor) {}
  DEVICE void cell(int k, R s, R share, R b, R c) {
    R side_b = Beam<AREA>::side(start_b, rate_b, s), side_c = Beam<AREA>::side(start_c, rate_c, s);
    Segment<R, AREA> segment{k, Covered<R>(b, side_b, size_b), Covered<R>(c, side_c, size_c), length * share};
    visitor.segment(segment, segment.of(matter), s);
  }
};

template <class R, int METHOD, class V> DEVICE V visited(const Scene& s, const Beam<METHOD>& ray, const V& visitor) {
  Segments<R, METHOD, V> segments(s, ray, visitor);
  walk<METHOD == AREA ? JOSEPH : METHOD, R>(s, ray, segments);
  return segments.visitor;
}

template <class R> struct Depth {
  Compensated<R> all;
  template <class G> DEVICE void segment(const G&, R m, R) { all += m; }
};

// What leaves a segment for the detector.
template <class R> struct Transmission {
  bool ascends;  // the detector stands at the first slab
  R all;
  Compensated<R> below;
  // The transmission from the segment's end on.
  DEVICE R next(R m) {
    R before = ascends ? below.value : max(all - below.value - m, (R)0);
    below += m;
    return exp(-before);
  }
};

template <class R, int METHOD> DEVICE Transmission<R> transmission_of(const Scene& s, const Beam<METHOD>& ray) {
  Transmission<R> transmission;
  transmission.ascends = ray.D < 0;
  transmission.all = transmission.ascends ? (R)0 : visited<R, METHOD>(s, ray, Depth<R>()).all.value;
  return transmission;
}

// Layers of magnification at equal steps of 1 / w, between two of which a segment is shared out linearly.
template <class R> struct Layers {
  int last;
  R way, start, first, scale;
  DEVICE Layers(const AttenuatedScene& s, const Ray& ray, Pixel p) : last(s.n_layers - 1), way((R)ray.D), start(0), first(0), scale(0) {
    if (!last) return;
    const double *line = s.lines + (long long)p.view * 12 * s.maps, *layers = s.layers + (long long)p.view * s.n_layers;
    start = (R)at(s, line, 2, ray.axis, p.u - (s.columns - 1) * 0.5, p.v - (s.rows - 1) * 0.5);
    first = (R)layers[0];
    scale = (R)(last / (layers[last] - layers[0]));
  }
  DEVICE void of(R s, int& layer, R& part) const {
    R place = way / (s - start);
    // a slab that a source stands in may have its middle on the other side: nearest
    R along = place * first >= 0 ? min(max((place - first) * scale, (R)0), (R)last) : (R)0;
    layer = min((int)along, last - 1);
    part = along - (R)layer;
  }
  // A pixel's value in its layers, at s.
  DEVICE R value(const R* values, R s) const {
    if (!last) return values[0];
    int layer;
    R part;
    of(s, layer, part);
    return values[layer] + part * (values[layer + 1] - values[layer]);
  }
};

// Adds up what is sent out: two layers at a time, which are written where a ray leaves them.
template <class R> struct Projection {
  Layers<R> layers;
  Store<R, 1> emission;
  Transmission<R> transmission;
  R* into;
  int layer;
  Compensated<R> low, high;
  DEVICE void write() {
    into[layer] += low.value;
    if (layers.last) into[layer + 1] += high.value;
    low = high = Compensated<R>();
  }
  template <class G> DEVICE void segment(const G& g, R m, R s) {
    R sent = transmission.next(m) * mean_passed(m) * g.of(emission), part = 0;
    if (layers.last) {
      int here;
      layers.of(s, here, part);
      if (here != layer) {
        write();
        layer = here;
      }
      high += part * sent;
    }
    low += sent - part * sent;
  }
};

template <class R, int METHOD> DEVICE void project_attenuated(const AttenuatedScene& s) {
  Pixel p = pixel_of(s);
  if (!on_detector(s, p)) return;
  Beam<METHOD> ray(s, p);
  long long pixels = (long long)s.n_views * s.rows * s.columns, pixel = blockIdx.y * pixels + index_of(s, p.view, p.v, p.u);
  R* into = (R*)s.views + pixel * s.n_layers;
  for (int k = 0; k < s.n_layers; k++) into[k] = 0;
  Store<R, 1> emission(s, ray.axis, blockIdx.y);
  Projection<R> projection{Layers<R>(s, ray, p), emission, transmission_of<R, METHOD>(s, ray), into, 0, {}, {}};
  visited<R, METHOD>(s, ray, projection).write();
}

// Adds numbers to voxels in fixed point: whole numbers add up to the same bits in any order.
template <class R> struct FixedPoint {
  const Scene& s;
  int axis, far, near;
  R scale;
  long long* into;
  DEVICE void to(int k, int b, int c, R value) {
    int place[3];
    UNROLL for (int i = 0; i < 3; i++) place[i] = i == axis ? k : i == far ? b - 1 : c - 1;
    UNROLL for (int i = 0; i < 3; i++) if (place[i] < 0 || place[i] >= s.sizes[i]) return;
    add_whole(into + ((long long)place[2] * s.sizes[1] + place[1]) * s.sizes[0] + place[0], (long long)(value * scale));
  }
  DEVICE void to(const Segment<R, AREA>& g, R value) {
    for (int i = g.b.low; i < g.b.high; i++)
      for (int j = g.c.low; j < g.c.high; j++) to(g.k, i, j, value * g.length * g.b.part(i) * g.c.part(j));
  }
  template <int METHOD> DEVICE void to(const Segment<R, METHOD>& g, R value) {
    if constexpr (METHOD == SIDDON) return to(g.k, g.b, g.c, value * g.length);
    R low = value * g.length * (1 - g.y), high = value * g.length * g.y;
    to(g.k, g.b, g.c, low * (1 - g.z));
    to(g.k, g.b, g.c + 1, low * g.z);
    to(g.k, g.b + 1, g.c, high * (1 - g.z));
    to(g.k, g.b + 1, g.c + 1, high * g.z);
  }
};

template <class R> DEVICE FixedPoint<R> fixed_of(const AttenuatedScene& s, const Ray& ray, int volume) {
  long long size = (long long)s.sizes[0] * s.sizes[1] * s.sizes[2];
  return {s, ray.axis, ray.far, ray.near, settled((R)s.fixed), (long long*)s.results + volume * size};
}

template <class R> struct Backprojection {
  Layers<R> layers;
  Transmission<R> transmission;
  const R* values;
  FixedPoint<R> into;
  template <class G> DEVICE void segment(const G& g, R m, R s) {
    into.to(g, transmission.next(m) * mean_passed(m) * layers.value(values, s));
  }
};

template <class R, int METHOD> DEVICE void backproject_attenuated(const AttenuatedScene& s) {
  Pixel p = pixel_of(s);
  if (!on_detector(s, p)) return;
  Beam<METHOD> ray(s, p);
  long long pixels = (long long)s.n_views * s.rows * s.columns, pixel = blockIdx.y * pixels + index_of(s, p.view, p.v, p.u);
  const R* values = (const R*)s.views + pixel * s.n_layers;
  Backprojection<R> backprojection{Layers<R>(s, ray, p), transmission_of<R, METHOD>(s, ray), values, fixed_of<R>(s, ray, blockIdx.y)};
  visited<R, METHOD>(s, ray, backprojection);
}

// The derivative by optical depths: a segment attenuates itself, and all those that stand farther from the detector.
template <class R> struct Source {
  const AttenuatedScene& s;
  Layers<R> layers;
  int axis;
  long long pixel, pixels;
  template <class G> DEVICE R of(const G& g, R along) const {
    R sum = 0;
    for (int n = 0; n < s.n_volumes - 1; n++)
      sum += layers.value((const R*)s.views + (n * pixels + pixel) * s.n_layers, along) * g.of(Store<R, 1>(s, axis, n));
    return sum;
  }
};

template <class R> struct Total {
  Source<R> source;
  Transmission<R> transmission;
  Compensated<R> all;
  template <class G> DEVICE void segment(const G& g, R m, R s) { all += transmission.next(m) * mean_passed(m) * source.of(g, s); }
};

template <class R> struct Derivative {
  Source<R> source;
  Transmission<R> transmission;
  R all;
  FixedPoint<R> into;
  Compensated<R> below;
  template <class G> DEVICE void segment(const G& g, R m, R s) {
    R from = transmission.next(m) * source.of(g, s), sent = from * mean_passed(m);
    R beyond = transmission.ascends ? all - below.value - sent : below.value;
    below += sent;
    into.to(g, from * slope_of_mean(m) - beyond);
  }
};

template <class R, int METHOD> DEVICE void vjp_attenuated(const AttenuatedScene& s) {
  Pixel p = pixel_of(s);
  if (!on_detector(s, p)) return;
  Beam<METHOD> ray(s, p);
  long long pixels = (long long)s.n_views * s.rows * s.columns;
  Source<R> source{s, Layers<R>(s, ray, p), ray.axis, index_of(s, p.view, p.v, p.u), pixels};
  Transmission<R> transmission = transmission_of<R, METHOD>(s, ray);
  R all = visited<R, METHOD>(s, ray, Total<R>{source, transmission, {}}).all.value;
  visited<R, METHOD>(s, ray, Derivative<R>{source, transmission, all, fixed_of<R>(s, ray, 0), {}});
}

#define ATTENUATED(suffix, R, T, NV, METHOD)                                                                           \
  ENTRY_OF(AttenuatedScene, survey##suffix, survey_rig)                                                                \
  ENTRY_OF(AttenuatedScene, store##suffix, (store_volumes<R, 1>))                                                      \
  ENTRY_OF(AttenuatedScene, project##suffix, (project_attenuated<R, METHOD>))                                          \
  ENTRY_OF(AttenuatedScene, backproject##suffix, (backproject_attenuated<R, METHOD>))                                  \
  ENTRY_OF(AttenuatedScene, mu_vjp##suffix, (vjp_attenuated<R, METHOD>))
#define DISTANCE_DRIVEN(suffix, R, T, NV, METHOD) ATTENUATED(suffix, R, T, NV, AREA)
