// The bounding box of non-zero voxels: for each axis the distance of its first voxel from the end, and its last plus one;
// both 0 if empty. A thread scans the voxels of one row after the other.
template <class T> DEVICE void find_occupied(const Scene& s) {
  long long voxels = (long long)s.part[0] * s.part[1] * s.part[2], at = thread_of();
  if (at >= voxels) return;
  bool any = false;
  for (int n = 0; n < s.n_volumes; n++) any = any || !(number(((const T*)s.volumes)[n * voxels + at]) == 0);
  if (!any) return;
  int place[3] = {(int)(at / ((long long)s.part[0] * s.part[1])), (int)(at / s.part[0] % s.part[1]), (int)(at % s.part[0])};
  UNROLL for (int i = 0; i < 3; i++) {
    int low = s.part[2 - i] - place[i], high = place[i] + 1;
    if (s.flags[i] < low) add_greatest(s.flags + i, low);
    if (s.flags[3 + i] < high) add_greatest(s.flags + 3 + i, high);
  }
}

// The head of an occupancy's code, see `occupancy.py`: shape, first voxel, one past the last, no shares.
DEVICE void write_occupied(const Scene& s) {
  if (thread_of() > 0) return;
  UNROLL for (int i = 0; i < 3; i++) {
    s.occupied[i] = s.part[2 - i];
    s.occupied[3 + i] = s.flags[i] ? s.part[2 - i] - s.flags[i] : 0;
    s.occupied[6 + i] = s.flags[3 + i];
  }
  s.occupied[9] = s.occupied[10] = -1;
  s.occupied[11] = 0;
}

#define ENTRY_OF(Packed, name, kernel) extern "C" __global__ void __launch_bounds__(BLOCK) name(const Packed s) { kernel(s); }
#define ENTRY(name, kernel) ENTRY_OF(Scene, name, kernel)
#define VARIANT(suffix, R, T, NV, METHOD)                                                                              \
  ENTRY(survey##suffix, survey_rig)                                                                                    \
  ENTRY(store##suffix, (store_volumes<T, NV>))                                                                         \
  ENTRY(project##suffix, (project_rays<R, T, NV, METHOD>))                                                             \
  ENTRY(record##suffix, (record_rays<R, NV, METHOD>))                                                                  \
  ENTRY(gather##suffix, (gather_voxels<R, NV, METHOD>))                                                                \
  ENTRY(scatter##suffix, (scatter_rays<R, NV, METHOD>))                                                                \
  ENTRY(vary##suffix, (vary_rays<R, T, NV, METHOD>))                                                                   \
  ENTRY(occupy##suffix, find_occupied<T>)                                                                              \
  ENTRY(bound##suffix, write_occupied)
