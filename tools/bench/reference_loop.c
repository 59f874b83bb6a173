/* The servo loop's skeleton in C: the yardstick that `softfinger bench loop` measures the real loop against.
 *
 * Same clock, same sleep, same real-time settings, same work besides the contact step: a call through a
 * pointer to read and one to write, a record into a ring, an eventfd to wake a reader that empties it.
 *
 *     reference_loop RATE_HZ TICKS PRIORITY RECORD_SIZE OUT
 *
 * PRIORITY 0 asks for no real-time setting. OUT receives TICKS triples of float64: lateness,
 * execution, and the whole tick until it sleeps again, s.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <time.h>
#include <unistd.h>

#define CAPACITY 8192

static int wake_fd;
static long record_size;
static double *ring;
static _Atomic int64_t head, tail, done;

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static int64_t device_read(int64_t handle, double *sample)
{
    double *poses = (double *)handle;
    memcpy(sample, poses, 9 * sizeof(double));
    return 0;
}

static int64_t device_write(int64_t handle, const double *wrench)
{
    double *kept = (double *)handle + 16;
    memcpy(kept, wrench, 6 * sizeof(double));
    return 0;
}

static void *reader(void *unused)
{
    double *out = malloc(record_size * sizeof(double));
    (void)unused;
    while (!atomic_load(&done)) {
        eventfd_t count;
        eventfd_read(wake_fd, &count);
        while (atomic_load(&tail) < atomic_load(&head)) {
            memcpy(out, ring + (tail % CAPACITY) * record_size, record_size * sizeof(double));
            atomic_fetch_add(&tail, 1);
        }
    }
    free(out);
    return NULL;
}

static void ask_for_real_time(int priority)
{
    struct sched_param parameter = {.sched_priority = priority};
    int32_t zero = 0;
    int latency = open("/dev/cpu_dma_latency", O_WRONLY);
    if (sched_setscheduler(0, SCHED_FIFO, &parameter))
        fprintf(stderr, "no SCHED_FIFO: %s\n", strerror(errno));
    if (mlockall(MCL_CURRENT))
        fprintf(stderr, "no mlockall: %s\n", strerror(errno));
    prctl(PR_SET_TIMERSLACK, 1);
    if (latency < 0 || write(latency, &zero, sizeof zero) != sizeof zero)
        fprintf(stderr, "no cpu_dma_latency\n");
}

int main(int count, char **words)
{
    static int64_t (*volatile read_device)(int64_t, double *) = device_read;
    static int64_t (*volatile write_device)(int64_t, const double *) = device_write;
    static double device[32];
    if (count != 6)
        return 2;
    double rate = atof(words[1]);
    long ticks = atol(words[2]);
    int priority = atoi(words[3]);
    record_size = atol(words[4]);
    int64_t period = (int64_t)(1e9 / rate + 0.5);
    double *figures = calloc(3 * ticks, sizeof(double));
    double *record = calloc(record_size, sizeof(double));
    ring = malloc(CAPACITY * record_size * sizeof(double));
    memset(ring, 0, CAPACITY * record_size * sizeof(double));
    memset(figures, 1, 3 * ticks * sizeof(double));
    wake_fd = eventfd(0, 0);
    pthread_t thread;
    pthread_create(&thread, NULL, reader, NULL);
    if (priority > 0)
        ask_for_real_time(priority);

    int64_t deadline = now_ns() + period;
    for (long tick = 0; tick < ticks; tick++) {
        struct timespec t = {deadline / 1000000000LL, deadline % 1000000000LL};
        double sample[10], wrench[6] = {0};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) == EINTR)
            ;
        int64_t woke = now_ns();
        read_device((int64_t)device, sample);
        wrench[0] = sample[0];
        write_device((int64_t)device, wrench);
        int64_t wrote = now_ns();
        record[0] = woke / 1e9;
        record[1] = tick;
        int64_t slot = atomic_load_explicit(&head, memory_order_relaxed);
        memcpy(ring + (slot % CAPACITY) * record_size, record, record_size * sizeof(double));
        atomic_store_explicit(&head, slot + 1, memory_order_release);
        eventfd_write(wake_fd, 1);
        int64_t slept = now_ns();
        figures[3 * tick] = (woke - deadline) / 1e9;
        figures[3 * tick + 1] = (wrote - woke) / 1e9;
        figures[3 * tick + 2] = (slept - woke) / 1e9;
        deadline += period;
        if (slept > deadline)
            deadline += ((slept - deadline) / period + 1) * period;
    }
    atomic_store(&done, 1);
    eventfd_write(wake_fd, 1);
    pthread_join(thread, NULL);
    FILE *out = fopen(words[5], "wb");
    if (!out || fwrite(figures, 3 * sizeof(double), ticks, out) != (size_t)ticks)
        return 1;
    return fclose(out);
}
