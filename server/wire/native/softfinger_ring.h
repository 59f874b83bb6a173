/* Reader of every tick of a local softfinger daemon, from shared memory. Linux; C11 with GNU extensions, or C++.
 *     struct softfinger_ring ring;
 *     if (softfinger_open(&ring, name)) return 1;       name: `ring` of `softfinger ctl describe`
 *     double *row = malloc(ring.width * sizeof *row);
 *     while (softfinger_wait(&ring, 1000))              until the daemon ends
 *         while (softfinger_read(&ring, row))           row[i]: the columns that `describe` lists, SI units
 *             use(row, ring.lost);                      lost: ticks overwritten before they were read
 *     softfinger_close(&ring);
 * The memory is mapped read-only: a slow, stopped or killed reader does not affect other programs. */
#ifndef SOFTFINGER_RING_H
#define SOFTFINGER_RING_H
#include <errno.h>
#include <fcntl.h>
#include <linux/futex.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>
enum { SF_LAYOUT = 1, SF_CAPACITY, SF_WIDTH, SF_ENDED, SF_HEAD = 8, SF_BELL, SF_ROWS = 4096 / 8 }; /* indices */
struct softfinger_ring { const int64_t *words; size_t bytes; int fd; int64_t width, next, lost; };
static inline int64_t softfinger_word(const struct softfinger_ring *r, int i)
{ return __atomic_load_n(r->words + i, __ATOMIC_ACQUIRE); }
static inline void softfinger_close(struct softfinger_ring *r)
{ munmap((void *)r->words, r->bytes), close(r->fd); }
/* Return 0, or -1 if the memory does not exist or has another layout. Reading starts at the next tick. */
static inline int softfinger_open(struct softfinger_ring *r, const char *name)
{
    char path[256];
    snprintf(path, sizeof path, "/dev/shm/%s", name);
    if ((r->fd = open(path, O_RDONLY | O_CLOEXEC)) < 0) return -1;
    r->bytes = (size_t)lseek(r->fd, 0, SEEK_END);
    r->words = (const int64_t *)mmap(NULL, r->bytes, PROT_READ, MAP_SHARED, r->fd, 0);
    if (r->words == MAP_FAILED) return close(r->fd), -1;
    if (memcmp(r->words, "softfing", 8) || r->words[SF_LAYOUT] != 1) return softfinger_close(r), -1;
    return r->width = r->words[SF_WIDTH], r->lost = 0, r->next = softfinger_word(r, SF_HEAD), 0;
}
/* Copy the oldest unread tick to `row` and return 1; return 0 if there is none. */
static inline int softfinger_read(struct softfinger_ring *r, double *row)
{
    int64_t capacity = r->words[SF_CAPACITY], head;
    while ((head = softfinger_word(r, SF_HEAD)) != r->next) {
        if (head - r->next < capacity) {
            memcpy(row, r->words + SF_ROWS + (r->next & (capacity - 1)) * r->width, r->width * sizeof *row);
            __atomic_thread_fence(__ATOMIC_ACQUIRE);
            if (softfinger_word(r, SF_HEAD) - r->next < capacity) return r->next++, 1;
        }
        head = softfinger_word(r, SF_HEAD) - capacity / 2; /* overwritten: skip to the middle */
        r->lost += head - r->next, r->next = head;
    }
    return 0;
}
/* Sleep until there are ticks to read, at most `ms`; return 0 once the daemon has exited and all ticks are read. */
static inline int softfinger_wait(struct softfinger_ring *r, long ms)
{
    struct timespec time = {ms / 1000, ms % 1000 * 1000000};
    uint32_t bell = (uint32_t)softfinger_word(r, SF_BELL); /* read before the head: a later tick ends the sleep */
    if (softfinger_word(r, SF_HEAD) != r->next) return 1;
    if (softfinger_word(r, SF_ENDED)) return 0;
    if (!syscall(SYS_futex, r->words + SF_BELL, FUTEX_WAIT, bell, &time, NULL, 0) || errno != ETIMEDOUT) return 1;
    return flock(r->fd, LOCK_SH | LOCK_NB) || flock(r->fd, LOCK_UN); /* the daemon has the lock while it runs */
}
#endif
