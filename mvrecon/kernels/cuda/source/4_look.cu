// Voxel-driven back-projection: volumes [n d h w] of what voxels see in views [n m v u], by maps [m 4 2 3] of an index to u w,
// v w, w and the fraction of the ray; see `voxels/reference.py`.
enum { IMAGE = 24, ALONG = 8 };  // numbers of a map, voxels along z of a thread

// A linear function, counted from a voxel: along z it is first + t step.
template <class R> struct Ramp {
  R first, step;
  DEVICE Ramp(double first, double step) : first((R)first), step((R)step) {}
  DEVICE R at(int t) const { return first + (R)t * step; }
};

// The pixel nearest to a place, on the detector: places are counted from it, so that their digits are those of a cell.
DEVICE int pixel_at(double top, double under, int size) {
  float place = (float)top * inverse((float)under) + (size - 1) * 0.5f;
  return under > 0 ? (int)min(max(floor(place), 0.0f), size - 1.0f) : 0;
}

template <class R> DEVICE R bilinear(const Field& f, const R* view, R u, R v, int u0, int v0) {
  R low_u = floor(u), low_v = floor(v), x = u - low_u, y = v - low_v, sum = 0;
  int left = u0 + (int)low_u, top = v0 + (int)low_v;
  UNROLL for (int n = 0; n < 4; n++) {
    int column = left + n % 2, row = top + n / 2;
    R weight = (n % 2 ? x : 1 - x) * (n / 2 ? y : 1 - y);
    if (within(column, f.source[0]) && within(row, f.source[1])) sum += weight * view[(long long)row * f.source[0] + column];
  }
  return sum;
}

template <class R> DEVICE void see(const Field& f, const double* map, const R* view, const double* p, R* total) {
  double base[4], step[4];
  UNROLL for (int i = 0; i < 4; i++) {
    base[i] = value(map + 6 * i, p);
    step[i] = map[6 * i + 3] * p[0] + map[6 * i + 4] * p[1] + map[6 * i + 5];
  }
  int u0 = pixel_at(base[0], base[2], f.source[0]), v0 = pixel_at(base[1], base[2], f.source[1]);
  double cu = middle(f.source[0]) - u0, cv = middle(f.source[1]) - v0;
  Ramp<R> us(base[0] + cu * base[2], step[0] + cu * step[2]), vs(base[1] + cv * base[2], step[1] + cv * step[2]);
  Ramp<R> under(base[2], step[2]), begun(base[3] - f.window[0], step[3]), left(f.window[1] - base[3], -step[3]);
  R low_u = (R)(-1 - u0), high_u = (R)(f.source[0] - u0), low_v = (R)(-1 - v0), high_v = (R)(f.source[1] - v0);
  UNROLL for (int t = 0; t < ALONG; t++) {
    R w = under.at(t), per = inverse(w), u = us.at(t) * per, v = vs.at(t) * per;
    bool counts = w > 0 && begun.at(t) > 0 && left.at(t) > 0 && low_u < u && u < high_u && low_v < v && v < high_v;
    if (counts) total[t] += (f.weighted ? per * per : (R)1) * bilinear(f, view, u, v, u0, v0);
  }
}

template <class R> DEVICE void look_up(const Field& f) {
  long long at = thread_of(), plane = (long long)f.shape[0] * f.shape[1];
  int z = (int)(at / plane) * ALONG;
  if (z >= f.shape[2]) return;
  double p[3] = {at % f.shape[0] - middle(f.shape[0]), at / f.shape[0] % f.shape[1] - middle(f.shape[1]), z - middle(f.shape[2])};
  long long pixels = (long long)f.source[0] * f.source[1];
  const R* view = (const R*)f.origin + (long long)blockIdx.y * f.kinds * pixels;
  R total[ALONG] = {};
  for (int m = 0; m < f.kinds; m++) see(f, f.maps + (long long)m * IMAGE, view + m * pixels, p, total);
  R* volume = (R*)f.result + ((long long)blockIdx.y * f.shape[2] + z) * plane + at % plane;
  UNROLL for (int t = 0; t < ALONG; t++)
    if (z + t < f.shape[2]) volume[t * plane] = total[t];
}
