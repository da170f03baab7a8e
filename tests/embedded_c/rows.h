/* Doubles from stdin, for the drivers of the parts: one, or some as numbers of the library. */
#ifndef ROWS_H
#define ROWS_H

#include <stdio.h>
#include <stdlib.h>

#include "rw_types.h"

static inline double one(void)
{
    double value;
    if (fread(&value, sizeof value, 1, stdin) != 1) exit(1);
    return value;
}

static inline void take(rw_real *to, int count)
{
    for (int i = 0; i < count; i++) to[i] = (rw_real)one();
}

#endif
