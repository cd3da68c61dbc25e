# Sets `jobs`: as many compilers at once as there are cores and memory for, 1.5 GB each (PCL's and JSON's templates need it).
jobs=$(nproc)
memory_jobs=$(awk '/^MemAvailable/ { print int($2 / 1500000) }' /proc/meminfo)
[ "$memory_jobs" -lt "$jobs" ] && jobs=$memory_jobs
[ "$jobs" -ge 1 ] || jobs=1
