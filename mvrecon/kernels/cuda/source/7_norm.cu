// Group normalisation and SiLU with channels last in memory, and its derivative: see `norms/reference.py`. A thread keeps to a
// channel and goes along the places of an item in steps of whole rows of channels, so that a warp reads what lies side by side.

// All that a kernel is launched with; `layer.py` has the same.
struct Layer {
  const void* features;  // [n p c]
  const void* change;    // of what was made of them [n p c]
  const void* scale;     // [c]
  const void* shift;     // [c]
  const double* sums;    // of features and of their squares [n 2 c]
  const double* back;    // of changes before SiLU, and of these times the normalised features [n 2 c]
  void* result;
  long long values;      // p c: of an item
  double eps;
  int channels, group;   // c, and how many of them are normalised together
  int rows, blocks;      // rows of channels that threads take at once; blocks of an item
};

// The values of a thread: at, at + step, .. of an item.
struct Walk {
  long long item, at, step;
  int channel;
  DEVICE Walk(const Layer& f) : item(blockIdx.x / f.blocks), step((long long)f.rows * f.channels) {
    at = (long long)(blockIdx.x % f.blocks) * BLOCK + threadIdx.x;
    channel = (int)(at % f.channels);
  }
  DEVICE bool counts() const { return at < step; }
  DEVICE long long start(const Layer& f) const { return item * f.values; }
  DEVICE void write(const Layer& f, double one, double two) const {
    double* sums = (double*)f.result + 2 * item * step + at + at / f.channels * f.channels;  // [n rows 2 c]
    sums[0] = one;
    sums[f.channels] = two;
  }
};

// Of a channel: z = (x - mean) factor + shift, normalised (x - mean) per; its group has so many values.
template <class R> struct Channel {
  R mean, per, scale, factor, shift;
  double count;
  int first;
  DEVICE Channel(const Layer& f, const Walk& walk) : first(walk.channel / f.group * f.group) {
    const double* sums = f.sums + 2 * walk.item * f.channels + first;
    double sum = 0, squares = 0;
    for (int c = 0; c < f.group; c++) {
      sum += sums[c];
      squares += sums[f.channels + c];
    }
    count = (double)(f.values / f.channels) * f.group;
    double middle = sum / count, variance = squares / count - middle * middle;
    variance = variance < 0 ? 0 : variance;  // what is not a number stays so
    mean = (R)middle;
    per = (R)(1 / sqrt(variance + f.eps));
    scale = ((const R*)f.scale)[walk.channel];
    factor = per * scale;
    shift = ((const R*)f.shift)[walk.channel];
  }
  DEVICE R act(R x) const {
    R z = (x - mean) * factor + shift;
    return z * inverse(1 + exp(-z));
  }
  // The change before SiLU.
  DEVICE R before(R x, R change) const {
    R z = (x - mean) * factor + shift, part = inverse(1 + exp(-z));
    return change * part * (1 + z * (1 - part));
  }
};

// Sums are counted from a thread's first value, so that a great mean costs no digits.
template <class R, class S> DEVICE void sum_features(const Layer& f) {
  Walk walk(f);
  if (!walk.counts()) return;
  const S* x = (const S*)f.features + walk.start(f);
  R base = (R)number(x[walk.at]), sum = 0, squares = 0;
  int count = 0;
  UNROLL_BY(4)
  for (long long i = walk.at; i < f.values; i += walk.step, count++) {
    R t = (R)number(x[i]) - base;
    sum += t;
    squares += t * t;
  }
  double from = base;
  walk.write(f, count * from + sum, squares + 2 * from * sum + count * from * from);
}

template <class R, class S> DEVICE void normalise(const Layer& f) {
  Walk walk(f);
  if (!walk.counts()) return;
  Channel<R> channel(f, walk);
  const S* x = (const S*)f.features + walk.start(f);
  R* y = (R*)f.result + walk.start(f);
  UNROLL_BY(4)
  for (long long i = walk.at; i < f.values; i += walk.step) y[i] = channel.act((R)number(x[i]));
}

template <class R, class S> DEVICE void sum_changes(const Layer& f) {
  Walk walk(f);
  if (!walk.counts()) return;
  Channel<R> channel(f, walk);
  const S* x = (const S*)f.features + walk.start(f);
  const R* change = (const R*)f.change + walk.start(f);
  R sum = 0, moment = 0;
  UNROLL_BY(4)
  for (long long i = walk.at; i < f.values; i += walk.step) {
    R value = (R)number(x[i]), before = channel.before(value, change[i]);
    sum += before;
    moment += before * ((value - channel.mean) * channel.per);
  }
  walk.write(f, sum, moment);
}

template <class R, class S> DEVICE void change_features(const Layer& f) {
  Walk walk(f);
  if (!walk.counts()) return;
  Channel<R> channel(f, walk);
  const double* back = f.back + 2 * walk.item * f.channels + channel.first;
  double sum = 0, moment = 0;
  for (int c = 0; c < f.group; c++) {
    double scale = ((const R*)f.scale)[channel.first + c];
    sum += scale * back[c];
    moment += scale * back[f.channels + c];
  }
  R part = (R)(1 / channel.count), even = part * (R)sum, tilt = part * (R)moment;
  const S* x = (const S*)f.features + walk.start(f);
  const R* change = (const R*)f.change + walk.start(f);
  R* result = (R*)f.result + walk.start(f);
  UNROLL_BY(4)
  for (long long i = walk.at; i < f.values; i += walk.step) {
    R value = (R)number(x[i]), normal = (value - channel.mean) * channel.per;
    result[i] = channel.per * (channel.scale * channel.before(value, change[i]) - even - normal * tilt);
  }
}
