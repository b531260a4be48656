/* Value references: 0 the time, commands, outputs, their means, 5 % and 95 % quantiles, gains of the
 * commands and biases of the outputs by faults, then what else NV variables are, seed, noise, and, if
 * RANGED is defined, whether the range of training is left. Above this text stand the
 * number NI of commands, NY and NV. */

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define COMMAND 1
#define OUTPUT (COMMAND + NI)
#define MEAN (OUTPUT + NY)
#define LOW (MEAN + NY)
#define HIGH (LOW + NY)
#define GAIN (HIGH + NY)
#define BIAS (GAIN + NI)
#define SEED NV
#define NOISY (NV + 1)
#define OUTSIDE (NV + 2)
