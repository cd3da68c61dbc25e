/* What the loadable module offers: plain C, so that nothing of PCL, Boost or VTK shows outside it. */
#pragma once
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

enum { CHIARO_PCL_ABI = 1, CHIARO_PCL_MESSAGE_BYTES = 512 };

typedef struct ChiaroPclField {
  char name[64];
  size_t offset, bytes, count;
  char type; /* F, I or U as in a PCD header */
} ChiaroPclField;

typedef struct ChiaroPclIcp {
  double target_from_source[16]; /* row by row */
  double rms_distance;
  int converged, iterations;
} ChiaroPclIcp;

/* Functions that return int give 0, or 1 with a message of at most CHIARO_PCL_MESSAGE_BYTES with its end. Points are x y z as floats, all
 * finite. */
typedef struct ChiaroPclFunctions {
  int abi;
  int (*read_pcd)(const char* path, void** cloud, char* message);
  void (*free_cloud)(void* cloud);
  size_t (*num_fields)(const void* cloud);
  void (*field)(const void* cloud, size_t index, ChiaroPclField* out);
  void (*rows)(const void* cloud, const void** data, size_t* bytes, size_t* row_bytes, size_t* num_points);
  /* keep[i] = 1 for the points that pcl::StatisticalOutlierRemoval leaves; 1 <= neighbours < count */
  int (*statistical_inliers)(const float* points, size_t count, int neighbours, double multiplier, uint8_t* keep, char* message);
  /* A k-d tree over a copy of the points. Searching is safe from many threads. */
  int (*tree_new)(const float* points, size_t count, void** tree, char* message);
  void (*tree_free)(void* tree);
  /* Nearest `k` points of each query, nearest first: indices and squared distances, k per query; returns how many per query (min(k,
   * points)). */
  size_t (*tree_search)(const void* tree, const float* queries, size_t num_queries, size_t k, uint32_t* indices, float* squared);
  int (*align_icp)(const float* source, size_t num_source, const float* target, size_t num_target, double max_distance, int max_iterations,
                   ChiaroPclIcp* out, char* message);
} ChiaroPclFunctions;

/* The one symbol that is looked up. */
const ChiaroPclFunctions* chiaro_pcl_functions(void);

#ifdef __cplusplus
}
#endif
