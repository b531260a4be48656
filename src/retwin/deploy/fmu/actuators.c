/* Delays, offsets and missed segments by past commands alone: CommandSpace, or, with AT_OUTPUTS,
 * DelayOffset, with one z for the whole simulation (see ActuatorStep). Above this text stand
 *
 *   DRAWS, ENSEMBLE       draws of z, and how many of them, the first, give means and quantiles
 *   WIDTH, LENGTH         channels that are delayed and offset, and their samples that are kept
 *   DELAY[DRAWS]          delays in samples, LENGTH - 2 at most
 *   OFFSET[DRAWS * WIDTH] offsets at CENTRE[WIDTH]
 *   SLOPE[WIDTH]          their change per unit, between BOTTOM[WIDTH] and TOP[WIDTH]
 *   MISSED[DRAWS * NU]    probabilities that an actuator misses a segment
 *   STILL[NU], CATCH[NU]  largest change of a command that counts as none, and at which an actuator
 *                         catches up, per sample */

#define MEMBER (REMEMBERED + 3 * NU + 1 + LENGTH * WIDTH)

#ifndef AT_OUTPUTS
/* The commands[NU] that actuators follow, changed in place: one that misses a segment stays where it
 * is. `state` holds the previous commands, those followed, the missed segments, and the samples since
 * a command changed. */
static void follow(int row, uint64_t seed, uint64_t sample, double *commands, double *state, int first)
{
    double *previous = state, *followed = state + NU, *missed = state + 2 * NU;
    double *resting = state + 3 * NU;
    int moving = 0;
    if (first) {
        memcpy(previous, commands, NU * sizeof *commands);
        memcpy(followed, commands, NU * sizeof *commands);
        *resting = 1.0;
    }
    for (int i = 0; i < NU; i++)
        moving |= fabs(commands[i] - previous[i]) > STILL[i];
    for (int i = 0; i < NU; i++) {
        double behind = commands[i] - followed[i];
        double limit = fmax(fabs(commands[i] - previous[i]), CATCH[i]);
        if (moving && *resting >= 1.0)
            missed[i] = uniform(seed, 1 + sample * NU + (uint64_t)i) < MISSED[row * NU + i];
        previous[i] = commands[i];
        if (missed[i] == 0.0)
            followed[i] = fabs(behind) <= limit ? commands[i] : followed[i] + copysign(limit, behind);
        commands[i] = followed[i];
    }
    *resting = moving ? 0.0 : *resting + 1.0;
}
#endif

/* The values[WIDTH], changed in place, with delay and offset. */
static void delay(int row, double *values, double *history, int first)
{
    int whole = (int)DELAY[row];
    double share = DELAY[row] - whole;
    for (int k = 0; k < LENGTH; k++)
        if (first || k + 1 == LENGTH)
            memcpy(history + k * WIDTH, values, WIDTH * sizeof *values);
        else
            memcpy(history + k * WIDTH, history + (k + 1) * WIDTH, WIDTH * sizeof *values);
    const double *after = history + (LENGTH - 1 - whole) * WIDTH, *before = after - WIDTH;
    for (int i = 0; i < WIDTH; i++) {
        double value = after[i] + share * (before[i] - after[i]);
        double within = fmin(fmax(value, BOTTOM[i]), TOP[i]);
        values[i] = value + OFFSET[row * WIDTH + i] + SLOPE[i] * (within - CENTRE[i]);
    }
}
