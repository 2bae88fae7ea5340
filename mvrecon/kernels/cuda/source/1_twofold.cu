// Numbers as sums of two floats, 48 binary digits, where float64 is slow: T. J. Dekker, Numer. Math. 18 (1971) 224.
struct Twofold { float high, low; };

// A product that is rounded by itself, and not together with a sum behind it.
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
