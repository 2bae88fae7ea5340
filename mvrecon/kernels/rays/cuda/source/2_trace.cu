// The course of a ray through the volume, with the names of `kernels/rays/cpu/trace.py`.

enum { FACE, OWN, FAR, NEAR };  // bounds of a ray: a face across its main axis, its own end, a face across another axis

struct Ray {
  int axis, far, near, first, last, from, to;
  double D;                          // voxels along the main axis from source to pixel
  double b, slope_b, c, slope_c;     // along far and near axis at the centre slab, counted from the border
  double begin, end, enter, leave, centre, length;
};

DEVICE double at(const Scene& s, const double* line, int kind, int axis, double u, double v) {
  const double* p = line + (kind * 3 + axis) * s.maps;
  return s.maps == 1 ? p[0] : p[0] * u + p[1] * v + p[2];
}

// Only division keeps a ray on a face exactly, for Siddon's method; others multiply.
template <int METHOD> DEVICE double over(double value, double by, double per) { return METHOD == SIDDON ? value / by : value * per; }

// The part of (lower, upper) in which low <= value + s slope < high.
template <int METHOD> DEVICE void across(double value, double slope, double low, double high, double& lower, double& upper) {
  if (slope == 0) {
    if (!(low <= value && value < high)) { lower = 0; upper = -1; }
    return;
  }
  double per = METHOD == SIDDON ? 0 : 1 / slope;
  double one = over<METHOD>(low - value, slope, per), two = over<METHOD>(high - value, slope, per);
  lower = max(lower, min(one, two));
  upper = min(upper, max(one, two));
}

DEVICE int main_axis(const Scene& s, const double* line, double u, double v) {
  const double tie = 1e-12;
  double x = fabs(at(s, line, 0, 0, u, v)), y = fabs(at(s, line, 0, 1, u, v)), z = fabs(at(s, line, 0, 2, u, v));
  return x * (1 + tie) >= y && x * (1 + 2 * tie) >= z ? 0 : y * (1 + tie) >= z ? 1 : 2;
}

template <int METHOD> DEVICE Ray trace(const Scene& s, const Box& box, const double* line, double u, double v, int a) {
  Ray r;
  double d[3] = {at(s, line, 0, 0, u, v), at(s, line, 0, 1, u, v), at(s, line, 0, 2, u, v)};
  int near = a == 2 ? 0 : 2, far = 3 - a - near;
  double D = pick(d, a), per = 1 / D;
  r.axis = a; r.far = far; r.near = near; r.D = D;
  r.slope_b = over<METHOD>(far == 0 ? d[0] : d[1], D, per);
  r.slope_c = over<METHOD>(near == 0 ? d[0] : d[2], D, per);
  double mb = at(s, line, 1, near, u, v), mc = at(s, line, 1, far, u, v);
  double value_b = over<METHOD>((far + 1) % 3 == a ? mb : -mb, D, per), value_c = over<METHOD>((near + 1) % 3 == a ? mc : -mc, D, per);
  double start = at(s, line, 2, a, u, v), one = start + s.window[0] * D, two = start + s.window[1] * D;
  double half_a = pick(s.sizes, a) * 0.5, half_b = pick(s.sizes, far) * 0.5, half_c = pick(s.sizes, near) * 0.5;
  const double reach = METHOD == SIDDON ? 0 : 0.5, half = half_a + (METHOD == TRILINEAR ? 0.5 : 0);
  r.begin = max(-half, min(one, two));
  r.end = min(half, max(one, two));
  r.from = r.begin > -half ? OWN : FACE;
  r.to = r.end < half ? OWN : FACE;
  if (METHOD == TRILINEAR) {  // samples are spaced along the way through the whole volume
    double begin = r.begin, end = r.end;
    across<METHOD>(value_b, r.slope_b, -half_b - reach, half_b + reach, r.begin, r.end);
    if (r.begin > begin) r.from = FAR;
    if (r.end < end) r.to = FAR;
    begin = r.begin; end = r.end;
    across<METHOD>(value_c, r.slope_c, -half_c - reach, half_c + reach, r.begin, r.end);
    if (r.begin > begin) r.from = NEAR;
    if (r.end < end) r.to = NEAR;
  }
  // a slab counts where it overlaps the ray
  const double slack = METHOD == JOSEPH ? 0.5 : 0, margin = METHOD == JOSEPH ? 0 : METHOD == SIDDON ? 0.5 : 1;
  r.enter = r.begin - slack;
  r.leave = r.end + slack;
  across<METHOD>(value_b, r.slope_b, pick(box.low, far) - half_b - reach, pick(box.high, far) - half_b + reach, r.enter, r.leave);
  across<METHOD>(value_c, r.slope_c, pick(box.low, near) - half_c - reach, pick(box.high, near) - half_c + reach, r.enter, r.leave);
  r.centre = half_a - 0.5;
  r.first = r.last = 0;
  if (r.begin < r.end && r.enter <= r.leave) {
    r.first = max(pick(box.low, a), (int)ceil(r.enter + r.centre - margin));
    r.last = min(pick(box.high, a), (int)floor(r.leave + r.centre + margin) + 1);
    if (METHOD != TRILINEAR) {  // a ray may end on a face, or so near that a rounded sum is beyond
      r.first += r.first + 0.5 <= r.begin + r.centre;
      r.last -= r.last - 1.5 >= r.end + r.centre;
    }
  }
  r.b = value_b + half_b + 0.5;
  r.c = value_c + half_c + 0.5;
  double wx = at(s, line, 3, 0, u, v), wy = at(s, line, 3, 1, u, v), wz = at(s, line, 3, 2, u, v);
  r.length = sqrt(wx * wx + wy * wy + wz * wz) * fabs(per);
  return r;
}

template <int METHOD> DEVICE Ray ray_of(const Scene& s, const Box& box, Pixel p) {
  const double* line = s.lines + (long long)p.view * 12 * s.maps;
  double u = p.u - (s.columns - 1) * 0.5, v = p.v - (s.rows - 1) * 0.5;
  return trace<METHOD>(s, box, line, u, v, main_axis(s, line, u, v));
}
