/* Variables that tests set and read by name. Included after KNOBS, a list X(name, first) of names with first values,
 * which become the fields of `k`. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define X(name, first) double name;
static struct { KNOBS } k;
#undef X
#define X(name, first) {#name, &k.name, first},
static const struct knob { const char *name; double *value, first; } knob[] = {KNOBS {0, 0, 0}};
#undef X

static double *at(const char *name)
{
    for (const struct knob *one = knob; one->name; one++)
        if (!strcmp(one->name, name)) return one->value;
    fprintf(stderr, "stub: no knob %s\n", name);
    abort();
}

static uint64_t random_bits(void)
{
    static uint64_t noise = 88172645463325252ull;
    noise ^= noise << 13;
    noise ^= noise >> 7;
    noise ^= noise << 17;
    return noise;
}
