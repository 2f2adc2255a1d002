/* Does sidestep.c answer as the program it was translated from? See README.md. */

#include "sidestep.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

/* How far off (m/s) an answer may be that just touches the speed limit: a square root of rounding. */
#define TOUCHING 3e-3f

/* One state, flat, to its answer. */
void sidestep_check(const float *in, float *out);
void sidestep_check(const float *in, float *out)
{
$adapter
}

#ifndef SIDESTEP_NO_MAIN

int main(int argc, char **argv)
{
    const char *path = argc > 1 ? argv[1] : "states.bin";
    FILE *file = fopen(path, "rb");
    uint32_t head[5];
    if (file == NULL || fread(head, sizeof head, 1, file) != 1 || head[0] != UINT32_C(0x53494445) ||
        head[2] != $inputs || head[3] != $outputs || head[4] != $loose) {
        fprintf(stderr, "%s is no file of states for this program\n", path);
        return 2;
    }
    uint32_t wrong = 0, open = 0, rough = 0;
    float largest = 0.0f;
    for (uint32_t k = 0; k < head[1]; k++) {
        float row[$inputs + $outputs + 1], out[$outputs];
        if (fread(row, sizeof row, 1, file) != 1) {
            fprintf(stderr, "%s is cut short\n", path);
            return 2;
        }
        sidestep_check(row, out);
        const float allowed = row[$inputs + $outputs];
        int same = 1, close = 1;
        for (int j = 0; j < $outputs; j++) {
            const float wanted = row[$inputs + j], off = fabsf(out[j] - wanted);
            if (!isfinite(out[j]) || !isfinite(wanted)) {
                same = same && !isfinite(out[j]) && !isfinite(wanted);
            } else if (isfinite(allowed) && j >= $loose) {
                same = same && off <= 0.0f;
            } else if (isfinite(allowed)) {
                same = same && off <= allowed + TOUCHING;
                close = close && off <= allowed;
                largest = off > largest && off > allowed ? off : largest;
            }
        }
        open += isfinite(allowed) ? 0 : 1;
        rough += close ? 0 : 1;
        if (!same && wrong++ < 5) {
            fprintf(stderr, "state %lu differs\n", (unsigned long)k);
        }
    }
    fclose(file);
    printf("%lu states: %lu differ, %lu by rounding only (at most %.2g), in %lu it decides between two answers\n",
           (unsigned long)head[1], (unsigned long)wrong, (unsigned long)rough, (double)largest,
           (unsigned long)open);
    return wrong > 0;
}

#endif
