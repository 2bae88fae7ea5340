// Traversal of a ray by each method. A visitor gets
//   cell(k, s, share, b, c)     Joseph: the bilinear cell at (b, c) of slab k, at s, of which the ray has a share
//   passage(k, s, passage)      Siddon: the at most three cells of slab k
//   sample(j, s, slab, x, b, c) trilinear: a sample between two slabs, x of the way, in the same cell of both
// and defines how many slabs to prefetch.
// Formulas as in `kernels/rays/cpu/`. Positions are counted from the border, so that truncation gives the cell.

template <class R> struct Course {
  R b, slope_b, c, slope_c, begin, end, centre;
  DEVICE explicit Course(const Ray& r)
      : b((R)r.b), slope_b((R)r.slope_b), c((R)r.c), slope_c((R)r.slope_c), begin((R)r.begin), end((R)r.end), centre((R)r.centre) {}
  DEVICE Course() {}
};

template <class R> DEVICE R overlap(R begin, R end, R s) { return min(end, s + (R)0.5) - max(begin, s - (R)0.5); }

template <class R, class V> DEVICE void joseph(const Course<R>& r, int first, int last, V& visitor) {
  if (first >= last) return;
  R s = (R)first - r.centre;
  visitor.cell(first, s, overlap(r.begin, r.end, s), r.b + s * r.slope_b, r.c + s * r.slope_c);
  // only the first and the last slab may hold a part of the ray
  UNROLL_BY(V::AHEAD)
  for (int k = first + 1; k < last - 1; k++) {
    s = (R)k - r.centre;
    visitor.cell(k, s, (R)1, r.b + s * r.slope_b, r.c + s * r.slope_c);
  }
  if (last - first < 2) return;
  s = (R)(last - 1) - r.centre;
  visitor.cell(last - 1, s, overlap(r.begin, r.end, s), r.b + s * r.slope_b, r.c + s * r.slope_c);
}

template <class R> struct Passage {
  R begin, length, to_b, to_c;
  int b0, b1, c0, c1;
  DEVICE R one() const { return min(to_b, to_c); }
  DEVICE R two() const { return max(to_b, to_c); }
  DEVICE bool b_first() const { return to_b < to_c; }
};

template <class R> struct Point { int cell; R part; };

// A ray along one axis, counted from the faces of cells. A crossing amplifies rounding by 1 / slope,
// so position and slope are two numbers each, and a position is exact to rounding of its part of a cell.
template <class R> struct Line {
  R whole, part, slope, rest;
  DEVICE Line() {}
  DEVICE Line(double place, double slope) : whole((R)floor(place)), part((R)(place - floor(place))), slope((R)slope), rest((R)(slope - (R)slope)) {}
  DEVICE Point<R> at(R s) const {
    Point<R> p;
    p.cell = (int)(whole + part + s * slope);
    p.part = fma(s, slope, whole - (R)p.cell) + fma(s, rest, part);
    if (p.part < 0) { p.cell--; p.part += 1; }
    if (p.part >= 1) { p.cell++; p.part -= 1; }
    return p;
  }
  DEVICE R per() const { return slope != 0 ? 1 / slope : 0; }  // a ray without slope stays in its cell
};

// Distance in a slab at which a ray passes from one cell to the next; the whole length if it does not.
template <class R> DEVICE R way(Point<R> from, Point<R> to, R per_slope, R length) {
  return from.cell == to.cell ? length : min(max(((to.cell > from.cell ? 1 : 0) - from.part) * per_slope, (R)0), length);
}

template <class R> DEVICE Passage<R> between(Point<R> b0, Point<R> b1, Point<R> c0, Point<R> c1, R per_b, R per_c, R begin, R length) {
  return {begin, length, way(b0, b1, per_b, length), way(c0, c1, per_c, length), b0.cell, b1.cell, c0.cell, c1.cell};
}

template <class R, class V> DEVICE void siddon(const Ray& ray, const Course<R>& r, V& visitor) {
  if (ray.first >= ray.last) return;
  Line<R> b(ray.b + 0.5, ray.slope_b), c(ray.c + 0.5, ray.slope_c);
  R per_b = b.per(), per_c = c.per(), s0 = max(r.begin, (R)ray.first - r.centre - (R)0.5);
  Point<R> b0 = b.at(s0), c0 = c.at(s0);
  for (int k = ray.first; k < ray.last; k++) {
    R s = (R)k - r.centre, s1 = min(r.end, s + (R)0.5);
    Point<R> b1 = b.at(s1), c1 = c.at(s1);
    visitor.passage(k, s, between(b0, b1, c0, c1, per_b, per_c, s0, s1 - s0));
    b0 = b1; c0 = c1; s0 = s1;
  }
}

// Samples of a ray that may be in the box, with a margin.
DEVICE void samples_in(const Ray& r, int count, int& first, int& last) {
  double step = (r.end - r.begin) / count;
  double low = max(r.enter, r.first - r.centre - 1), high = min(r.leave, r.last - r.centre);
  first = last = 0;
  if (r.first >= r.last || low > high) return;
  first = (int)min(max(floor((low - r.begin) / step - 1.5), 0.0), (double)count);
  last = (int)min(max(floor((high - r.begin) / step + 1.5) + 1, 0.0), (double)count);
}

template <class R, class V> DEVICE void trilinear(const Ray& ray, const Course<R>& r, int samples, V& visitor) {
  int low, high;
  samples_in(ray, samples, low, high);
  R step = (R)((ray.end - ray.begin) / samples), enter = (R)ray.enter, leave = (R)ray.leave;
  for (int j = low; j < high; j++) {
    R s = r.begin + ((R)j + (R)0.5) * step, x = s + r.centre;
    int slab = max((int)floor(x), -1);  // only rounding carries a sample in front of slab -1
    if (enter <= s && s <= leave && ray.first - 1 <= slab && slab < ray.last)
      visitor.sample(j, s, slab, x - (R)slab, r.b + s * r.slope_b, r.c + s * r.slope_c);
  }
}

template <int METHOD, class R, class V> DEVICE void walk(const Scene& s, const Ray& ray, V& visitor) {
  Course<R> r(ray);
  if constexpr (METHOD == JOSEPH) joseph(r, ray.first, ray.last, visitor);
  if constexpr (METHOD == SIDDON) siddon(ray, r, visitor);
  if constexpr (METHOD == TRILINEAR) trilinear(ray, r, s.samples, visitor);
}
