/* A sender in C over libzmq: the yardstick that `softfinger bench telemetry` measures the daemon against.
 *
 * It sends one message of a tick a period, both frames made once, with time and number put in, from the thread
 * that wakes: no servo, no ring, no other thread but libzmq's own.
 *
 *     reference_sender LIBZMQ ENDPOINT RATE_HZ TOPIC BODY TIMESTAMP_AT TICK_AT
 *
 * BODY is a file with the message's map; at the two places in it are eight bytes each, the highest first: the time
 * since the epoch, s, as float64, and the tick as int64. Ends with the process.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <endian.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define ZMQ_PUB 1
#define ZMQ_LINGER 17
#define ZMQ_SNDHWM 23
#define ZMQ_SNDMORE 2

static int64_t now_ns(clockid_t clock)
{
    struct timespec t;
    clock_gettime(clock, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

int main(int argc, char **argv)
{
    if (argc != 8)
        return 2;
    void *library = dlopen(argv[1], RTLD_NOW);
    if (!library) {
        fprintf(stderr, "%s\n", dlerror());
        return 1;
    }
    void *(*make_context)(void) = dlsym(library, "zmq_ctx_new");
    void *(*make_socket)(void *, int) = dlsym(library, "zmq_socket");
    int (*set)(void *, int, const void *, size_t) = dlsym(library, "zmq_setsockopt");
    int (*bind_to)(void *, const char *) = dlsym(library, "zmq_bind");
    int (*give)(void *, const void *, size_t, int) = dlsym(library, "zmq_send");

    static char body[65536];
    FILE *file = fopen(argv[5], "rb");
    size_t size = file ? fread(body, 1, sizeof body, file) : 0;
    char *timestamp_at = body + atoi(argv[6]), *tick_at = body + atoi(argv[7]);
    int none = 0;
    void *socket = make_socket(make_context(), ZMQ_PUB);
    set(socket, ZMQ_SNDHWM, &none, sizeof none);
    set(socket, ZMQ_LINGER, &none, sizeof none);
    if (!size || bind_to(socket, argv[2]))
        return 1;

    int64_t period = (int64_t)(1e9 / atof(argv[3])), due = now_ns(CLOCK_MONOTONIC);
    for (uint64_t tick = 0;; tick++) {
        due += period;
        struct timespec until = {due / 1000000000LL, due % 1000000000LL};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL))
            ;
        double timestamp = now_ns(CLOCK_REALTIME) * 1e-9;
        uint64_t bits;
        memcpy(&bits, &timestamp, sizeof bits);
        bits = htobe64(bits);
        memcpy(timestamp_at, &bits, sizeof bits);
        bits = htobe64(tick);
        memcpy(tick_at, &bits, sizeof bits);
        give(socket, argv[4], strlen(argv[4]), ZMQ_SNDMORE);
        give(socket, body, size, 0);
    }
}
