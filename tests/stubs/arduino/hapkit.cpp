// The sketch examples/hapkit/hapkit.ino as a program of this machine, in real time behind a pseudo terminal. What an
// AVR differs in and this misses: int of 16 bits, the speed of the processor, the sensor's noise, a line of 115200 Bd
// (a pseudo terminal is faster), the boot loader's two seconds after the port is opened, and the motor itself.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <ctime>

#include <sys/ioctl.h>
#include <unistd.h>

using byte = uint8_t;
enum { OUTPUT, HIGH = 1, LOW = 0, A2 = 2 };
using std::fabs;
using std::sqrt;

static volatile double magnet;           // counts, as far as the magnet has turned; the test turns it
static volatile int forward, duty;       // of the motor
static volatile bool running, muted;
static volatile int taken, processed;    // bytes from the host; those of ended loops
static uint8_t TCCR0B = 3;
static int line = -1;

struct Change { double at, torque; };
static Change changes[1 << 16];
static volatile int changed;

static double now() {
  timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec + 1e-9 * t.tv_nsec;
}

static double torque() { return (forward ? 1 : -1) * 0.03 * (duty / 255.0) * (duty / 255.0); }

static unsigned long micros() { return (uint32_t)(uint64_t)(now() * 1e6 * ((TCCR0B & 7) == 1 ? 64 : 1)); }
static void pinMode(int, int) {}
static void digitalWrite(int, int value) { forward = value; }
static void analogWrite(int, int value) {
  double before = torque();
  duty = value;
  if (torque() != before && changed < (1 << 16)) { changes[changed] = {now(), torque()}; changed = changed + 1; }
}
static int analogRead(int) {
  double turn = fmod(magnet, 980.0);
  return 20 + (int)(turn < 0 ? turn + 980.0 : turn);
}

static struct {
  void begin(long) {}
  int available() { int n = 0; return ioctl(line, FIONREAD, &n) == 0 ? n : 0; }
  int read() { byte b; taken = taken + 1; return ::read(line, &b, 1) == 1 ? b : -1; }
  void write(const byte *data, int size) { if (!muted) { ssize_t kept = ::write(line, data, size); (void)kept; } }
} Serial;

#include SKETCH

extern "C" {
void board_start(int fd) {
  line = fd; changed = taken = processed = 0; duty = forward = 0; TCCR0B = 3; muted = false; running = true; setup();
}
void board_run() { while (running) { loop(); processed = taken; usleep(50); } }
void board_stop() { running = false; }
void board_turn(double counts) { magnet = counts; }
void board_mute(int yes) { muted = yes; }
double board_torque() { return torque(); }
int board_processed() { return processed; }
int board_changes(double *out, int most) {
  int count = changed < most ? changed : most;
  memcpy(out, changes, count * sizeof(Change));
  return count;
}
}
