/* A stub for 3D Systems' libHD: what the headers of OpenHaptics 3 and the programs that use it say of it, with two
 * simulated handles behind it. Written before the driver, from these words and not from the driver:
 *
 *  - The library has a thread of its own, the scheduler, which calls what was scheduled once a millisecond, until that
 *    returns 0.
 *  - State (0x2000 to 0x24ff, forces and torques 0x27xx) is read and set between hdBeginFrame and hdEndFrame of the
 *    device, in the same thread; a force that was set goes to the motors with the end of the frame. One frame a tick.
 *  - THE MOTORS KEEP THE LAST FORCE FOR EVER: a callback that returns, a scheduler that stops and a device that is
 *    disabled change nothing. Only a zero, or the output switched off, ends it. (The maker does not say what they do;
 *    this is the worst.)
 *  - Errors are put on a stack of STACK places, which drops what does not fit; hdGetError takes the newest off, and
 *    gives code, internal code and device by value.
 *  - The current device is one for each thread.
 *  - Frame: x right, y up, z towards the user; mm, N, mN m. The matrix is stored column by column.
 *  - The inkwell switch is 0 while the stylus is docked. Motor temperatures are 0 (cold) to 1 (hot).
 *
 * What it does not show: what the true library takes for a call, and whether it bears calls of other threads; what the
 * motors do when the program is killed or the cable is pulled (here: keep the force; none, without power); force
 * ramping; the limits of force impulse and of velocity but as errors on demand; Touch_Setup and its files; whether the
 * inkwell switch of each model is as said; how long a calibration holds.
 *
 * Tests steer it through stub_set and stub_get, by the names in KNOBS, and look at the force of every tick in its log.
 */
#define _GNU_SOURCE
#include <math.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>
#include <time.h>
#include <unistd.h>

typedef uint32_t HHD, HDenum, HDerror;
typedef struct { HDerror code; int32_t internal; HHD device; } HDErrorInfo;
typedef uint32_t (*Callback)(void *);

enum {
    INVALID_ENUM = 0x100, INVALID_VALUE = 0x101, INVALID_OPERATION = 0x102, BAD_HANDLE = 0x104, WARM = 0x200,
    FAST = 0x203, FAULT = 0x300, INITIATED = 0x301, COMM = 0x302, ILLEGAL_BEGIN = 0x400, ILLEGAL_END = 0x401,
    FRAME = 0x402, FULL = 0x501
};
enum {
    BUTTONS = 0x2000, INKWELL = 0x2002, POSITION = 0x2050, TRANSFORM = 0x2052, MODEL = 0x2501, SERIAL = 0x2504,
    VERSION = 0x2500, WORKSPACE = 0x2551, INPUT_DOF = 0x2553, OUTPUT_DOF = 0x2554, STYLE = 0x2555, MAX_FORCE = 0x2603,
    TEMPERATURE = 0x2605, FORCE = 0x2700, TORQUE = 0x2701, FORCE_OUTPUT = 0x4000
};
enum { DEVICES = 2, OPS = 8, STACK = 16, ROWS = 1 << 16, SUBSTEPS = 10 };
enum { DOCKED_STYLE = 4 };
static const HHD NONE = 0xffffffff;
static const HHD HANDLE[DEVICES] = {17, 42};

#define KNOBS \
 /* what is attached: so many, models by number (see MODELS), serial, styles of calibration, what is to be done for it */ \
    X(devices, 1) X(model, 0) X(serial, 70001) X(style, 2) X(calibration, 0x5000) X(updates_needed, 1) \
    X(held, 0) X(init_error, 0) X(outputs, 3) X(max_force, 3.3) \
 /* whether x (mm) is the fraction of the monotonic clock's second, so that its age can be told */ \
    X(clock, 0) \
 /* the handles and the hands, kg, N s/m, N/m, N */ \
    X(mass, 0.1) X(damping, 8) X(stiffness, 1000) \
 /* a hand's path, mm, Hz and rad, in the library's frame: centre, amplitude of a sine in x and z and a cosine in y, of
    a sine turn about an axis (0, 1, 2), or a turn that stays; of the second device the centre is 100 mm to the right */ \
    X(x, 0) X(y, 20) X(z, 0) X(ax, 0) X(ay, 0) X(az, 0) X(hz, 1) X(turn, 0) X(turned, 0) X(axis, 1) \
    X(buttons, 0) X(docked, 0) X(temperature, 0.1) X(mirror, 0) \
 /* faults: at the frame of that number or from it on (-1 never); for `only` of the devices (-1 all) */ \
    X(only, -1) X(internal, 7) X(unplugged, 0) \
    X(delay_at, -1) X(delay_s, 0) X(drop_at, -1) X(hang_at, -1) X(garbage, 0) X(refuse_force, 0) X(rate_hz, 1000) \
 /* what was asked of it, to be read */ \
    X(opens, 0) X(closes, 0) X(starts, 0) X(stops, 0) X(running, 0) X(ticks, 0) X(frames, 0) X(errors, 0) X(misuse, 0) \
    X(updated, 0) X(update_style, 0) X(scheduled, 0) X(peak, 0) X(output_sets, 0)

#include "knobs.h"

static const char *const MODELS[] = {
    "Touch", "Touch X", "PHANTOM Omni", "PHANTOM Desktop", "PHANTOM Premium 1.5 6DOF", "PHANTOM Premium 3.0 6DOF",
    "Something new"
};

struct device {
    bool open, output, in_frame;
    pthread_t framer;
    double frames, position[3], velocity[3], set_force[3], set_torque[3], force[3], torque[3];
    int64_t framed_tick;
};
static struct device device[DEVICES];

static struct op { Callback call; void *data; unsigned priority; long handle; } ops[OPS];
static HDErrorInfo stack[STACK];
static int height;
static pthread_mutex_t guard = PTHREAD_MUTEX_INITIALIZER, calling = PTHREAD_MUTEX_INITIALIZER;
static pthread_t scheduler;
static bool scheduling;
static __thread HHD current = 0xffffffff;
static __thread bool in_scheduler;

/* A row for each device in each tick, and for each change in between: when (ns), which, what the motors give. */
struct row { int64_t ns; int64_t device; double force[3]; double torque[3]; };
static struct { int64_t count; int64_t pad[7]; struct row row[ROWS]; } journal;

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000ll + now.tv_nsec;
}

static double clock_mm(void) { return (double)(now_ns() % 1000000000ll) * 1e-6; }

/* What the motors of a device give: nothing without power, or with the output off. */
static bool powered(int d) { return device[d].output && !(k.unplugged && (k.only < 0 || k.only == d)); }

static void note(int d)
{
    struct row *row = &journal.row[journal.count % ROWS];
    const bool on = powered(d);
    row->ns = now_ns();
    row->device = d;
    for (int i = 0; i < 3; i++) {
        row->force[i] = on ? device[d].force[i] : 0;
        row->torque[i] = on ? device[d].torque[i] : 0;
    }
    __atomic_store_n(&journal.count, journal.count + 1, __ATOMIC_RELEASE);
}

static void push(int code, HHD which)
{
    pthread_mutex_lock(&guard);
    k.errors += 1;
    if (height < STACK) stack[height++] = (HDErrorInfo){(HDerror)code, (int32_t)k.internal, which};
    pthread_mutex_unlock(&guard);
}

static int place(HHD which)
{
    for (int d = 0; d < DEVICES; d++)
        if (which == HANDLE[d] && device[d].open) return d;
    return -1;
}

static int misused(int code) { k.misuse += 1; push(code, current); return -1; }

/* The current device, where its state may be asked for or set; else -1 and an error. */
static int framed(HDenum what)
{
    const int d = place(current);
    if (d < 0) return misused(BAD_HANDLE);
    const bool state = (what >= 0x2000 && what < 0x2500) || what == FORCE || what == TORQUE;
    if (state && (!device[d].in_frame || !pthread_equal(device[d].framer, pthread_self()))) return misused(FRAME);
    return d;
}

static bool mine(int d) { return k.only < 0 || k.only == d; }

/* --- the hand and the handle ------------------------------------------------------------------------ */

static void goal(int d, double t, double out[3])
{
    const double w = 2 * M_PI * k.hz;
    out[0] = k.x + 100 * d + k.ax * sin(w * t);
    out[1] = k.y + k.ay * cos(w * t);
    out[2] = k.z + k.az * sin(w * t);
}

static double turn_now(double t) { return k.turned + k.turn * sin(2 * M_PI * k.hz * t); }

static void pass(int d, double t, double dt)
{
    const double h = dt / SUBSTEPS;
    for (int n = 0; n < SUBSTEPS; n++) {
        double to[3];
        goal(d, t + n * h, to);
        for (int i = 0; i < 3; i++) {
            const double force = powered(d) ? device[d].force[i] : 0;
            const double pull = k.stiffness * (to[i] - device[d].position[i]) * 1e-3;
            device[d].velocity[i] += h / k.mass * (force + pull - k.damping * device[d].velocity[i]);
            device[d].position[i] += h * device[d].velocity[i] * 1e3;
        }
    }
}

/* --- for tests -------------------------------------------------------------------------------------- */

void stub_set(const char *name, double value) { *at(name) = value; }
double stub_get(const char *name) { return *at(name); }
void *stub_journal(void) { return &journal; }
void stub_reset(void)
{
    for (const struct knob *one = knob; one->name; one++)
        if (one->value != &k.running && one->value != &k.ticks) *one->value = one->first;
    pthread_mutex_lock(&guard);
    height = 0;
    pthread_mutex_unlock(&guard);
    __atomic_store_n(&journal.count, 0, __ATOMIC_RELEASE);
    for (int d = 0; d < DEVICES; d++) {
        memset(&device[d], 0, sizeof device[d]);
        device[d].framed_tick = -1;
        goal(d, 0, device[d].position);
    }
}
void stub_force(int d, double out[6])
{
    for (int i = 0; i < 3; i++) {
        out[i] = powered(d) ? device[d].force[i] : 0;
        out[3 + i] = powered(d) ? device[d].torque[i] : 0;
    }
}
void stub_push(int code, int d, int many) { while (many-- > 0) push(code, d < 0 ? NONE : HANDLE[d]); }

/* --- errors ----------------------------------------------------------------------------------------- */

HDErrorInfo hdGetError(void)
{
    HDErrorInfo newest = {0, 0, NONE};
    pthread_mutex_lock(&guard);
    if (height > 0) newest = stack[--height];
    pthread_mutex_unlock(&guard);
    return newest;
}
const char *hdGetErrorString(HDerror code)
{
    switch (code) {
    case 0: return "no error";
    case WARM: return "the motors are too warm";
    case FAST: return "the maximum velocity was exceeded";
    case FAULT: return "device fault";
    case COMM: return "communication error";
    default: return "error";
    }
}

/* --- devices ---------------------------------------------------------------------------------------- */

HHD hdInitDevice(const char *name)
{
    const int d = name && !strcmp(name, "Left Device") ? 1 : 0;
    if (name && d == 0 && strcmp(name, "Default Device")) { push(INVALID_VALUE, NONE); return NONE; }
    if (k.held) { push(INITIATED, NONE); return NONE; }
    if (k.init_error) { push((int)k.init_error, NONE); return NONE; }
    if (k.unplugged || d >= k.devices) { push(COMM, NONE); return NONE; }
    if (device[d].open) { push(INITIATED, NONE); return NONE; }
    if (scheduling) { push(INVALID_OPERATION, NONE); return NONE; }  /* all devices come before the scheduler starts */
    k.opens += 1;
    device[d].open = true;
    device[d].framed_tick = -1;
    current = HANDLE[d];
    return current;
}
void hdDisableDevice(HHD which)
{
    const int d = place(which);
    if (d < 0) { misused(BAD_HANDLE); return; }
    for (int n = 0; n < OPS; n++)
        if (ops[n].call && scheduling && k.devices < 2) k.misuse += 1;  /* what is scheduled would go on without it */
    k.closes += 1;
    device[d].open = false;
    device[d].in_frame = false;
}
void hdMakeCurrentDevice(HHD which)
{
    if (place(which) < 0) { misused(BAD_HANDLE); return; }
    current = which;
}
HHD hdGetCurrentDevice(void) { return current; }

void hdBeginFrame(HHD which)
{
    const int d = place(which);
    if (d < 0) { misused(BAD_HANDLE); return; }
    current = which;
    if (device[d].in_frame) { misused(ILLEGAL_BEGIN); return; }
    if (in_scheduler && device[d].framed_tick == (int64_t)k.ticks) misused(FRAME);
    device[d].in_frame = true;
    device[d].framer = pthread_self();
    device[d].framed_tick = (int64_t)k.ticks;
    memcpy(device[d].set_force, device[d].force, sizeof device[d].force);
    memcpy(device[d].set_torque, device[d].torque, sizeof device[d].torque);
    const double n = device[d].frames++;
    k.frames += 1;
    if (!mine(d)) return;
    if (k.unplugged) push(COMM, which);
    if (n == k.delay_at) usleep((useconds_t)(k.delay_s * 1e6));
}
void hdEndFrame(HHD which)
{
    const int d = place(which);
    if (d < 0) { misused(BAD_HANDLE); return; }
    if (!device[d].in_frame || !pthread_equal(device[d].framer, pthread_self())) { misused(ILLEGAL_END); return; }
    device[d].in_frame = false;
    double norm = 0;
    for (int i = 0; i < 3; i++) norm += device[d].set_force[i] * device[d].set_force[i];
    norm = sqrt(norm);
    memcpy(device[d].force, device[d].set_force, sizeof device[d].force);
    memcpy(device[d].torque, device[d].set_torque, sizeof device[d].torque);
    if (powered(d) && norm > k.peak) k.peak = norm;
    note(d);
}

static bool *switched(HDenum what)
{
    const int d = framed(0);
    if (d < 0) return 0;
    if (what != FORCE_OUTPUT) { misused(INVALID_ENUM); return 0; }
    return &device[d].output;
}
void hdEnable(HDenum what)
{
    bool *value = switched(what);
    if (!value) return;
    if (k.refuse_force) { push(INVALID_OPERATION, current); return; }
    k.output_sets += 1;
    *value = true;
}
void hdDisable(HDenum what)
{
    bool *value = switched(what);
    if (!value) return;
    *value = false;
    note(place(current));
}
unsigned char hdIsEnabled(HDenum what) { bool *value = switched(what); return value && *value; }

static double random_number(void)
{
    const uint64_t bits = random_bits();
    double value;
    memcpy(&value, &bits, sizeof value);
    return bits % 3 == 0 ? (double)(bits % 2001) / 1000 - 1 : value;
}

void hdGetDoublev(HDenum what, double *out)
{
    const int d = framed(what);
    if (d < 0) return;
    const double span[6] = {-80, -60, -35, 80, 60, 35};
    switch (what) {
    case POSITION:
        for (int i = 0; i < 3; i++) out[i] = k.garbage ? random_number() : device[d].position[i];
        if (k.clock != 0) out[0] = clock_mm();
        break;
    case TRANSFORM: {
        const double a = turn_now(k.ticks / k.rate_hz);
        const int i0 = (int)k.axis, i1 = (i0 + 1) % 3, i2 = (i0 + 2) % 3;
        memset(out, 0, 16 * sizeof *out);
        out[4 * i0 + i0] = k.mirror ? -1 : 1;
        out[4 * i1 + i1] = out[4 * i2 + i2] = cos(a);
        out[4 * i2 + i1] = -sin(a);
        out[4 * i1 + i2] = sin(a);
        for (int i = 0; i < 3; i++) out[12 + i] = device[d].position[i];
        if (k.clock != 0) out[12] = clock_mm();
        out[15] = 1;
        for (int i = 0; k.garbage && i < 16; i++) out[i] = random_number();
        break;
    }
    case FORCE: memcpy(out, device[d].force, 3 * sizeof *out); break;
    case TORQUE: memcpy(out, device[d].torque, 3 * sizeof *out); break;
    case TEMPERATURE:
        for (int i = 0; i < 6; i++) out[i] = i == 1 ? k.temperature : 0.05;
        break;
    case MAX_FORCE: *out = k.max_force; break;
    case WORKSPACE: memcpy(out, span, sizeof span); break;
    default: misused(INVALID_ENUM);
    }
}
void hdGetIntegerv(HDenum what, int32_t *out)
{
    const int d = framed(what);
    if (d < 0) return;
    switch (what) {
    case BUTTONS: *out = (int32_t)k.buttons; break;
    case INPUT_DOF: *out = 6; break;
    case OUTPUT_DOF: *out = (int32_t)k.outputs; break;
    case STYLE: *out = (int32_t)k.style; break;
    default: misused(INVALID_ENUM);
    }
}
void hdGetBooleanv(HDenum what, unsigned char *out)
{
    if (framed(what) < 0) return;
    if (what == INKWELL) *out = !k.docked; else misused(INVALID_ENUM);
}
const char *hdGetString(HDenum what)
{
    static char text[32];
    const int d = framed(what);
    if (d < 0) return "";
    switch (what) {
    case MODEL: return MODELS[(int)k.model];
    case SERIAL: snprintf(text, sizeof text, "%d", (int)k.serial + d); return text;
    case VERSION: return "3.40.0";
    default: misused(INVALID_ENUM); return "";
    }
}
void hdSetDoublev(HDenum what, const double *value)
{
    const int d = framed(what);
    if (d < 0) return;
    if (what != FORCE && what != TORQUE) { misused(INVALID_ENUM); return; }
    for (int i = 0; i < 3; i++) {
        if (!isfinite(value[i])) { misused(INVALID_VALUE); return; }
        (what == FORCE ? device[d].set_force : device[d].set_torque)[i] = value[i];
    }
}

/* --- calibration ------------------------------------------------------------------------------------ */

HDenum hdCheckCalibration(void)
{
    if (framed(0) < 0) return 0x5000;
    if ((int)k.calibration == 0x5002 && (int)k.style == DOCKED_STYLE && k.docked) k.calibration = 0x5001;
    return (HDenum)k.calibration;
}
void hdUpdateCalibration(HDenum style)
{
    if (framed(0) < 0) return;
    k.updated += 1;
    k.update_style = style;
    if (!((int)k.style & (int)style)) { misused(INVALID_VALUE); return; }
    if (k.updated >= k.updates_needed) k.calibration = 0x5000;
}

/* --- scheduler -------------------------------------------------------------------------------------- */

static void tick(void)
{
    pthread_mutex_lock(&calling);
    for (int n = 0; n < OPS; n++) {
        if (k.drop_at >= 0 && k.frames >= k.drop_at) ops[n].call = 0;  /* a callback that is not called any more */
        if (ops[n].call && ops[n].call(ops[n].data) == 0) ops[n].call = 0;
    }
    pthread_mutex_unlock(&calling);
    for (int d = 0; d < DEVICES; d++) {
        if (!device[d].open) continue;
        pass(d, k.ticks / k.rate_hz, 1 / k.rate_hz);
        note(d);
    }
}

static void *schedule(void *nothing)
{
    (void)nothing;
    in_scheduler = true;
    int64_t due = now_ns();
    while (__atomic_load_n(&scheduling, __ATOMIC_ACQUIRE)) {
        if (k.hang_at >= 0 && k.frames >= k.hang_at) usleep(1000);  /* a library that stands still */
        else tick();
        k.ticks += 1;
        due += (int64_t)(1e9 / k.rate_hz);
        if (now_ns() > due + 5000000) due = now_ns();  /* late: no ticks are made up for */
        const struct timespec until = {due / 1000000000ll, due % 1000000000ll};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, 0);
    }
    return 0;
}

void hdStartScheduler(void)
{
    if (scheduling) { misused(INVALID_OPERATION); return; }
    k.starts += 1;
    k.running = 1;
    __atomic_store_n(&scheduling, true, __ATOMIC_RELEASE);
    pthread_create(&scheduler, 0, schedule, 0);
}
void hdStopScheduler(void)
{
    if (!scheduling) { misused(INVALID_OPERATION); return; }
    k.stops += 1;
    __atomic_store_n(&scheduling, false, __ATOMIC_RELEASE);
    pthread_join(scheduler, 0);
    k.running = 0;
}
unsigned long hdScheduleAsynchronous(Callback call, void *data, unsigned short priority)
{
    for (int n = 0; n < OPS; n++) {
        if (ops[n].call) continue;
        k.scheduled += 1;
        ops[n].data = data;
        ops[n].priority = priority;
        ops[n].handle = 100 + n;
        __atomic_store_n(&ops[n].call, call, __ATOMIC_RELEASE);
        return (unsigned long)ops[n].handle;
    }
    push(FULL, NONE);
    return 0;
}
void hdUnschedule(unsigned long handle)
{
    if (!in_scheduler) pthread_mutex_lock(&calling);  /* one that is under way is waited for */
    for (int n = 0; n < OPS; n++)
        if (ops[n].call && (unsigned long)ops[n].handle == handle) ops[n].call = 0;
    if (!in_scheduler) pthread_mutex_unlock(&calling);
}

__attribute__((constructor)) static void begin(void) { stub_reset(); }
