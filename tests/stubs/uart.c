// UART semantics for the pseudo terminal of `emulators/slowline.py`, loaded with LD_PRELOAD. On a pseudo terminal
// TIOCOUTQ is always 0, and a flush keeps bytes that the other side has not read. Here, after tty_ioctl(4) and
// termios(3):
//
//   TIOCOUTQ                bytes written to the port that the line has not carried
//   TCFLSH, tcflush(3)      drop these bytes before the call returns
//
// SLOW_LINE names the file shared with the emulator; it contains the device number of the terminal.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

struct line {
  volatile long written;  // bytes that the port has taken; ours
  volatile long gone;     // of these, carried or dropped; the emulator's
  volatile long flushed;  // flushes asked for; ours
  volatile long heeded;   // of these, done; the emulator's
  unsigned long terminal; // its device number
};

static struct line *line;
static int (*ioctl_of_libc)(int, unsigned long, ...);
static ssize_t (*write_of_libc)(int, const void *, size_t);

__attribute__((constructor)) static void open_line(void) {
  ioctl_of_libc = (int (*)(int, unsigned long, ...))dlsym(RTLD_NEXT, "ioctl");
  write_of_libc = (ssize_t (*)(int, const void *, size_t))dlsym(RTLD_NEXT, "write");
  const char *name = getenv("SLOW_LINE");
  int fd = name ? open(name, O_RDWR | O_CLOEXEC) : -1;
  if (fd < 0) return;
  void *shared = mmap(NULL, sizeof *line, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
  close(fd);
  if (shared != MAP_FAILED) line = shared;
}

static int ours(int fd) {
  struct stat of;
  return line && fstat(fd, &of) == 0 && S_ISCHR(of.st_mode) && of.st_rdev == line->terminal;
}

ssize_t write(int fd, const void *data, size_t size) {
  ssize_t taken = write_of_libc(fd, data, size);
  if (taken > 0 && ours(fd)) line->written += taken;
  return taken;
}

int ioctl(int fd, unsigned long request, ...) {
  va_list rest;
  va_start(rest, request);
  void *argument = va_arg(rest, void *);
  va_end(rest);
  if (request == TIOCOUTQ && ours(fd)) {
    *(int *)argument = (int)(line->written - line->gone);
    return 0;
  }
  int flushes = request == TCFLSH && (long)argument != TCIFLUSH && ours(fd);
  long wanted = flushes ? ++line->flushed : 0;
  int code = ioctl_of_libc(fd, request, argument);
  if (code == 0 && flushes) {
    struct timespec step = {0, 100000};
    for (int k = 0; k < 20000 && line->heeded < wanted; k++) nanosleep(&step, NULL);
  }
  return code;
}

int tcflush(int fd, int queue) { return ioctl(fd, TCFLSH, (long)queue); }
