// The rig's flags and matrices, stores of volumes, and projection.

// The flags of all views, and matrices from points to pixels; a thread a view.
// A matrix solves source + w (U u + V v + A) = X, for parallel beams O + U u + V v + w A = X (Cramer's rule).
DEVICE void cross(const double* one, const double* two, int stride, double* out) {
  UNROLL for (int i = 0; i < 3; i++) {
    int p = (i + 1) % 3 * stride, q = (i + 2) % 3 * stride;
    out[i] = one[p] * two[q] - one[q] * two[p];
  }
}

DEVICE void write_frame(const double* line, float* frame) {
  bool parallel = true;
  for (int i = 0; i < 3; i++) parallel = parallel && line[i * 3] == 0 && line[i * 3 + 1] == 0;
  const double *U = line + (parallel ? 18 : 0), *V = U + 1, *A = line + 2, *start = line + 20;
  double rows[3][4];
  cross(V, A, 3, rows[0]);
  cross(A, U, 3, rows[1]);
  cross(U, V, 3, rows[2]);
  double determinant = 0, scale = 0;
  for (int i = 0; i < 3; i++) determinant += rows[0][i] * U[i * 3];
  if (parallel) rows[2][0] = rows[2][1] = rows[2][2] = 0;
  for (int row = 0; row < 3; row++) {
    rows[row][3] = row == 2 && parallel ? determinant : 0;
    for (int i = 0; i < 3; i++) rows[row][3] -= rows[row][i] * start[i * 3];
  }
  for (int i = 0; i < 4; i++) scale += fabs(rows[2][i]);
  for (int row = 0; row < 3; row++)
    for (int i = 0; i < 4; i++) frame[row * 4 + i] = scale > 0 ? (float)(rows[row][i] / scale) : 0.0f;
}

// Whether a ray of a view may run fastest along z: at its corners a linear direction is greatest, and least if of one sign.
DEVICE bool may_be_steep(const Scene& s, const double* line) {
  double least[2] = {1e300, 1e300}, greatest = 0, sign[2] = {0, 0};
  for (int corner = 0; corner < 4; corner++) {
    double u = (corner % 2 ? 0.5 : -0.5) * (s.columns - 1), v = (corner / 2 ? 0.5 : -0.5) * (s.rows - 1);
    greatest = max(greatest, fabs(at(s, line, 0, 2, u, v)));
    for (int i = 0; i < 2; i++) {
      double d = at(s, line, 0, i, u, v);
      if (d * sign[i] < 0) least[i] = 0;
      sign[i] = d;
      least[i] = min(least[i], fabs(d));
    }
  }
  return greatest * (1 + 1e-9) >= max(least[0], least[1]);
}

DEVICE void survey_rig(const Scene& s) {
  long long view = thread_of();
  if (view >= s.n_views) return;
  const double* line = s.lines + view * 12 * s.maps;
  if (may_be_steep(s, line)) add_bits(s.flags, STEEP);
  if (s.frames && s.maps == 3) write_frame(line, s.frames + view * 12);
}

// Padding of a store: two zero voxels before, as rounding may move a ray's end into the cell before, and two behind.
struct Layout { int low[3]; long long size[3], cells; };
DEVICE Layout layout_of(const Scene& s) {
  Layout l;
  Box box = stored_box(s);
  UNROLL for (int i = 0; i < 3; i++) {
    l.low[i] = box.low[i] - 1;
    l.size[i] = box.high[i] - box.low[i] + 4;
  }
  l.cells = l.size[0] * l.size[1] * l.size[2];
  return l;
}

// Volumes as stores: for x and y as main axes z-fastest, for z x-fastest, where some ray needs it. A thread copies a few
// cells that lie side by side in the volume, or in the store.
enum { RUN = 8 };
template <class T, int NV> DEVICE void store_volumes(const Scene& s) {
  int flat = blockIdx.y % 2, group = blockIdx.y / 2;
  if (flat && !(s.flags[0] & STEEP)) return;
  Layout l = layout_of(s);
  int fast = flat ? 0 : 2, middle = flat ? 1 : 0, slow = 3 - middle - fast;
  long long runs = (pick(l.size, middle) + RUN - 1) / RUN, thread = thread_of();
  if (thread >= runs * pick(l.size, fast) * pick(l.size, slow)) return;
  int i = (int)(thread % pick(l.size, fast)), run = (int)(thread / pick(l.size, fast) % runs), k = (int)(thread / pick(l.size, fast) / runs);
  const T* from = (const T*)s.volumes;
  Many<T, NV>* into = (Many<T, NV>*)s.stores + ((long long)flat * ((s.n_volumes + NV - 1) / NV) + group) * l.cells;
  long long voxels = (long long)s.part[0] * s.part[1] * s.part[2];
  for (int j = run * RUN; j < min((long long)(run + 1) * RUN, pick(l.size, middle)); j++) {
    int x = (flat ? i : j) + l.low[0] - 1 - s.corner[0], y = (flat ? j : k) + l.low[1] - 1 - s.corner[1], z = (flat ? k : i) + l.low[2] - 1 - s.corner[2];
    bool inside = x >= 0 && y >= 0 && z >= 0 && x < s.part[0] && y < s.part[1] && z < s.part[2];
    long long place = ((long long)z * s.part[1] + y) * s.part[0] + x;
    Many<T, NV> many;
    UNROLL for (int n = 0; n < NV; n++)
      many.n[n] = inside && group * NV + n < s.n_volumes ? from[(group * NV + n) * voxels + place] : T{};
    into[(k * pick(l.size, middle) + j) * pick(l.size, fast) + i] = many;
  }
}

// The store that a ray reads: slab k, and (b, c) counted from the border, lies at k along + b far + c cells. In bytes,
// since the product of two ints, added to an address, is one instruction.
template <class T, int NV> struct Store {
  typedef Many<T, NV> Cell;
  enum { SIZE = sizeof(Cell) };
  const char* from;
  int along, far;
  DEVICE Store(const Scene& s, int axis, int group) {
    Layout l = layout_of(s);
    bool flat = axis == 2;
    along = SIZE * (int)(flat ? l.size[0] * l.size[1] : axis == 0 ? l.size[2] : l.size[0] * l.size[2]);
    far = SIZE * (int)(flat ? l.size[0] : axis == 0 ? l.size[0] * l.size[2] : l.size[2]);
    from = (const char*)s.stores + SIZE * ((long long)flat * ((s.n_volumes + NV - 1) / NV) + group) * l.cells;
    from -= (long long)(pick(l.low, axis) - 1) * along + (long long)pick(l.low, axis == 1 ? 0 : 1) * far + SIZE * pick(l.low, flat ? 0 : 2);
  }
  DEVICE const Cell* at(int k, int b, int c) const {
    return (const Cell*)(from + (long long)k * along + (long long)b * far + (long long)c * SIZE);
  }
  DEVICE const Cell* farther(const Cell* p) const { return (const Cell*)((const char*)p + far); }
  DEVICE const Cell* next_slab(const Cell* p) const { return (const Cell*)((const char*)p + along); }
};

template <class R, class T, int NV> struct Sum {
  enum { AHEAD = 4 };
  Store<T, NV> store;
  R step, total[NV];
  DEVICE Sum(const Scene& s, const Ray& ray, int group) : store(s, ray.axis, group) {
    step = (R)((ray.end - ray.begin) / max(s.samples, 1));
    UNROLL for (int n = 0; n < NV; n++) total[n] = 0;
  }
  DEVICE void plane(const Many<T, NV>* p, R share, R y, R z) {
    const Many<T, NV>* q = store.farther(p);
    Many<T, NV> low = p[0], high = p[1], low2 = q[0], high2 = q[1];
    UNROLL for (int n = 0; n < NV; n++) {
      R one = number(low.n[n]), two = number(low2.n[n]);
      R lower = one + z * (number(high.n[n]) - one), upper = two + z * (number(high2.n[n]) - two);
      total[n] += share * (lower + y * (upper - lower));
    }
  }
  DEVICE void cell(int k, R, R share, R b, R c) {
    int ib = (int)b, ic = (int)c;
    plane(store.at(k, ib, ic), share, b - (R)ib, c - (R)ic);
  }
  DEVICE void sample(int, R, int slab, R x, R b, R c) {
    int ib = (int)b, ic = (int)c;
    const Many<T, NV>* p = store.at(slab, ib, ic);
    plane(p, step * (1 - x), b - (R)ib, c - (R)ic);
    plane(store.next_slab(p), step * x, b - (R)ib, c - (R)ic);
  }
  DEVICE void passage(int k, R, const Passage<R>& p) {
    Many<T, NV> first = *store.at(k, p.b0, p.c0), last = *store.at(k, p.b1, p.c1);
    Many<T, NV> middle = p.b_first() ? *store.at(k, p.b1, p.c0) : *store.at(k, p.b0, p.c1);
    UNROLL for (int n = 0; n < NV; n++)
      total[n] += p.one() * number(first.n[n]) + (p.two() - p.one()) * number(middle.n[n]) + (p.length - p.two()) * number(last.n[n]);
  }
};

template <class R, class T, int NV, int METHOD> DEVICE void project_rays(const Scene& s) {
  Pixel p = pixel_of(s);
  if (!on_detector(s, p)) return;
  Ray ray = ray_of<METHOD>(s, read_box(s), p);
  Sum<R, T, NV> sum(s, ray, blockIdx.y);
  walk<METHOD, R>(s, ray, sum);
  long long pixels = (long long)s.n_views * s.rows * s.columns, pixel = index_of(s, p.view, p.v, p.u);
  R* views = (R*)s.views;
  UNROLL for (int n = 0; n < NV; n++)
    if ((int)blockIdx.y * NV + n < s.n_volumes) views[(blockIdx.y * NV + n) * pixels + pixel] = (R)ray.length * sum.total[n];
}
