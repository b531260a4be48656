/* What stands above the C files of every kernel; see `compiled_files` in `compiler.py`. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT
#endif

typedef long long i64;

