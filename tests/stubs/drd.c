/* A stub for Force Dimension's libdrd: the semantics of its public header, with a simulated handle behind it.
 *
 * Written from the header's rules, not from the driver. Frame of the library: x towards the user, y right, z up.
 * A hand holds the handle by a spring and follows a path; the handle weighs, and falls if nobody carries it.
 * The hand's time passes by `step_s` with each reading of the pose, so that a run does not depend on the machine. The
 * watchdog's does not: it is in the device, which knows of no readings, so it counts real time since the last force
 * command. Nothing else feeds it: not enabling the force, not setting the watchdog.
 *
 * Tests steer it through stub_set and stub_get, by the names in KNOBS, and read what it was asked to do.
 */
#include <math.h>
#include <pthread.h>
#include <stdbool.h>
#include <time.h>
#include <unistd.h>

enum { COM = 2, BUSY = 3, NO_DEVICE = 5, NOT_AVAILABLE = 6, TIMEOUT = 7, EXPERT_OFF = 9, INDEX = 15, IN_USE = 20 };
enum { BUTTON = 1, VELOCITY, WATCHDOG, SOFTWARE };
enum { SUBSTEPS = 10 };

static __thread int last_error;

#define KNOBS \
 /* what is attached */ \
    X(devices, 1) X(type, 33) X(serial, 1234) X(initialized, 1) X(wrist, 0) \
    X(active_wrist, 0) X(gripper, 0) X(gripper_rad, 0.3) X(left, 0) X(buttons, 0) X(held, 0) \
 /* the handle and the hand, kg, N s/m, N/m, N, s */ \
    X(mass, 0.25) X(damping, 8) X(stiffness, 1000) X(motor_max, 20) X(step_s, 0.001) \
 /* the hand's path, m, Hz and rad, in the library's frame: centre, amplitudes of a sine in x and y and a cosine in z, \
    and of a sine turn about an axis (0, 1, 2), or a turn that stays */ \
    X(x, 0) X(y, 0) X(z, 0.02) X(ax, 0) X(ay, 0) X(az, 0) X(hz, 1) X(turn, 0) X(axis, 0) \
    X(turned, 0) X(mirror, 0) \
 /* faults: from this call on or at it (-1 never), or at every so many; the error that a failing call gives */ \
    X(fail_read, -1) X(fail_write, -1) X(fail_open, 0) X(error, COM) X(unplug_at, -1) \
    X(delay_at, -1) X(delay_s, 0) X(slow_s, 0) X(exclusive, 0) \
    X(garbage, 0) X(refuse_init, 0) X(refuse_watchdog, 0) X(error_word, 0) X(refuse_frame, 0) \
    X(refuse_brakes, 0) X(enable_s, 0) \
 /* what was asked of it, to be read */ \
    X(opens, 0) X(closes, 0) X(reads, 0) X(writes, 0) X(force_on, 0) X(expert, 0) \
    X(watchdog, 0) X(threshold, 0) X(gravity, 1) X(brakes, 1) X(max_force, 0) X(moved, 0) \
    X(regulated, 0) X(cause, 0) X(fx, 0) X(fy, 0) X(fz, 0) X(torque_sent, 0) \
    X(tx, 0) X(ty, 0) X(tz, 0) X(disables, 0) X(stops, 0) X(gripper_sent, 0) X(peak, 0) X(expert_misuse, 0) X(threads, 0) X(unplugged, 0)

#include "knobs.h"
static double position[3], velocity[3], now_s;
static volatile int64_t fed_ns;
enum { LOGGED = 1 << 14 };
static double given[LOGGED][4];
static int gifts;
static volatile int inside;

static void put_back(void)
{
    const double goal[3] = {k.x, k.y, k.z + k.az};
    memcpy(position, goal, sizeof position);
    memset(velocity, 0, sizeof velocity);
    now_s = 0;
}

static void watch(void);

void stub_set(const char *name, double value) { *at(name) = value; }
double stub_get(const char *name) { watch(); return *at(name); }
int stub_busy(void) { return inside; }
void stub_reset(void)
{
    for (const struct knob *one = knob; one->name; one++) *one->value = one->first;
    fed_ns = 0;
    gifts = 0;
    put_back();
}

/* What the motors give now; a device without power or with its force off gives nothing. */
void stub_force(double *out)
{
    watch();
    const bool on = k.force_on && !k.unplugged;
    out[0] = on ? k.fx : 0;
    out[1] = on ? k.fy : 0;
    out[2] = on ? k.fz : 0;
}

/* What the motors were given so far: time (s, monotonic clock) and force (N), rows of 4; returns how many. */
int stub_log(double *out, int rows)
{
    if (rows > gifts) rows = gifts;
    memcpy(out, given, rows * sizeof *given);
    return rows;
}

static void note(void)
{
    struct timespec now;
    if (gifts == LOGGED) return;
    clock_gettime(CLOCK_MONOTONIC, &now);
    given[gifts][0] = now.tv_sec + 1e-9 * now.tv_nsec;
    given[gifts][1] = k.fx;
    given[gifts][2] = k.fy;
    given[gifts++][3] = k.fz;
}

static int fail(int error) { last_error = error; return -1; }

static int usable(int id)
{
    watch();
    if (k.unplugged) return fail(COM);
    if (id != 7 || k.opens <= k.closes) return fail(INDEX);  /* IDs are not numbers: the first open device has 7 */
    return 0;
}

/* The maker's words: stopping disables the force and puts the device into brake mode, in which the circuits of its
 * motors are closed in themselves and drag. */
static void force_off(int cause)
{
    k.force_on = 0;
    k.brakes = 1;
    k.fx = k.fy = k.fz = 0;
    k.cause = cause;
    note();
}

static void watch(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    const int64_t since = now.tv_sec * 1000000000ll + now.tv_nsec - fed_ns;
    if (k.watchdog > 0 && k.force_on && since > k.watchdog * 125000) force_off(WATCHDOG);
}

static void feed(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    fed_ns = now.tv_sec * 1000000000ll + now.tv_nsec;
}

static void pass(double dt)
{
    const double h = dt / SUBSTEPS, m = k.mass, w = 2 * M_PI * k.hz;
    for (int n = 0; n < SUBSTEPS; n++) {
        now_s += h;
        const double goal[3] = {k.x + k.ax * sin(w * now_s), k.y + k.ay * sin(w * now_s), k.z + k.az * cos(w * now_s)};
        double f[3];
        stub_force(f);
        if (k.gravity && k.force_on) f[2] += m * 9.81;  /* carried only inside a force that is set */
        f[2] -= m * 9.81;
        double speed = 0;
        for (int i = 0; i < 3; i++) {
            velocity[i] += h / m * (f[i] + k.stiffness * (goal[i] - position[i]) - k.damping * velocity[i]);
            position[i] += h * velocity[i];
            speed += velocity[i] * velocity[i];
        }
        /* The header does not say the unit; here it is mm/s. */
        if (k.threshold > 0 && sqrt(speed) > k.threshold * 1e-3 && k.force_on) force_off(VELOCITY);
    }
}

/* An exchange; with `exclusive`, a second one waits for the first. */
static pthread_mutex_t one_at_a_time = PTHREAD_MUTEX_INITIALIZER;
static __thread bool holds;
static void enter(void)
{
    holds = k.exclusive != 0;
    if (holds) pthread_mutex_lock(&one_at_a_time);
    if (__sync_fetch_and_add(&inside, 1)) k.threads += 1;
}
static void leave(void)
{
    __sync_fetch_and_sub(&inside, 1);
    if (holds) pthread_mutex_unlock(&one_at_a_time);
}

int dhdErrorGetLast(void) { return last_error; }
const char *dhdErrorGetStr(int error)
{
    switch (error) {
    case 0: return "no error";
    case COM: return "communication error";
    case BUSY: case IN_USE: return "device is already in use";
    case NO_DEVICE: return "no device found";
    case TIMEOUT: return "timeout";
    default: return "error";
    }
}
const char *dhdErrorGetLastStr(void) { return dhdErrorGetStr(last_error); }
void dhdGetSDKVersion(int *a, int *b, int *c, int *d) { *a = 3; *b = 17; *c = 5; *d = 0; }
int dhdGetDeviceCount(void) { return k.unplugged ? 0 : (int)k.devices; }

int drdOpenID(char number)
{
    if (k.unplugged || number < 0 || number >= k.devices) return fail(NO_DEVICE);
    if (k.held) return fail(IN_USE);
    if (k.fail_open) return fail((int)k.error);
    if (k.opens > k.closes) return fail(IN_USE);
    k.opens += 1;
    k.serial = floor(k.serial / 10) * 10 + number;  /* serial numbers tell the devices apart by their last digit */
    k.regulated = 0;
    k.gravity = 1;
    put_back();
    return 7;
}
int drdClose(char id)
{
    if (id != 7 || k.opens <= k.closes) return fail(INDEX);
    k.closes += 1;
    if (k.force_on) force_off(SOFTWARE);
    return 0;
}
int dhdGetSystemType(char id) { return usable(id) ? -1 : (int)k.type; }
int dhdGetSerialNumber(unsigned short *out, char id)
{
    if (usable(id)) return -1;
    *out = (unsigned short)k.serial;
    return 0;
}
bool dhdHasWrist(char id) { return !usable(id) && k.wrist; }
bool dhdHasActiveWrist(char id) { return !usable(id) && k.active_wrist; }
bool dhdHasGripper(char id) { return !usable(id) && k.gripper; }
bool dhdIsLeftHanded(char id) { return !usable(id) && k.left; }
bool drdIsInitialized(char id) { return !usable(id) && k.initialized; }
int drdAutoInit(char id)
{
    if (usable(id)) return -1;
    if (k.refuse_init) return fail(TIMEOUT);
    k.moved += 1;
    k.initialized = k.regulated = 1;
    return 0;
}
int drdStop(bool leave_force, char id)
{
    if (usable(id)) return -1;
    k.regulated = 0;
    if (!leave_force) force_off(SOFTWARE);
    return 0;
}
int dhdEnableExpertMode(void) { k.expert = 1; return 0; }
int dhdDisableExpertMode(void) { k.expert = 0; return 0; }
static int expert(char id)
{
    if (usable(id)) return -1;
    if (!k.expert) { k.expert_misuse += 1; return fail(EXPERT_OFF); }
    return 0;
}
int dhdSetWatchdog(unsigned char units, char id)
{
    if (expert(id)) return -1;
    if (k.refuse_watchdog) return fail((int)k.refuse_watchdog);
    k.watchdog = units;
    return 0;
}
int dhdSetVelocityThreshold(unsigned value, char id)
{
    if (expert(id)) return -1;
    k.threshold = value;
    return 0;
}
int dhdSetMaxForce(double newton, char id) { if (usable(id)) return -1; k.max_force = newton; return 0; }
int dhdSetGravityCompensation(int on, char id) { if (usable(id)) return -1; k.gravity = on; return 0; }
int dhdSetBrakes(int on, char id)
{
    if (usable(id)) return -1;
    if (k.refuse_brakes) return fail(NOT_AVAILABLE);
    if (on) force_off(SOFTWARE);
    k.brakes = on;
    return 0;
}
int dhdEnableForce(unsigned char on, char id)
{
    if (usable(id)) return -1;
    if (on && k.enable_s > 0) {
        enter();
        usleep((useconds_t)(k.enable_s * 1e6));
        leave();
    }
    if (on) { k.force_on = 1; k.cause = k.brakes = 0; } else { k.disables += 1; force_off(SOFTWARE); }
    return 0;
}
int dhdStop(char id) { if (usable(id)) return -1; k.stops += 1; force_off(SOFTWARE); return 0; }
unsigned dhdGetButtonMask(char id) { return usable(id) ? 0 : (unsigned)k.buttons; }
int dhdGetGripperAngleRad(double *out, char id)
{
    if (usable(id)) return -1;
    if (!k.gripper) return fail(NOT_AVAILABLE);
    *out = k.left ? -k.gripper_rad : k.gripper_rad;  /* as CHAI3D and cisst find it */
    return 0;
}
int dhdGetStatus(int status[17], char id)
{
    if (usable(id)) return -1;
    memset(status, 0, 17 * sizeof *status);
    status[0] = status[1] = status[2] = status[3] = 1;
    status[5] = (int)k.force_on;
    status[6] = (int)k.brakes;
    status[9] = (int)k.error_word;
    status[14] = (int)k.cause;
    return 0;
}

/* Bits of any kind: NaN, infinities, subnormals, huge and plausible numbers. */
static int garbage(double *p[3], double m[9])
{
    for (int i = 0; i < 12; i++) {
        uint64_t bits = random_bits();
        double value;
        memcpy(&value, &bits, sizeof value);
        if (bits % 3 == 0) value = (double)(bits % 2001) / 1000 - 1;
        *(i < 3 ? p[i] : m + i - 3) = value;
    }
    k.buttons = (double)(uint32_t)random_bits();
    return (int)(random_bits() % 3);
}

static int pose(double *px, double *py, double *pz, double m[3][3], char id)
{
    double *const p[3] = {px, py, pz};
    if (k.unplug_at == k.reads) k.unplugged = 1;
    if (usable(id)) return -1;
    enter();
    const double n = k.reads++;
    int code = 0;
    if (n == k.delay_at) usleep((useconds_t)(k.delay_s * 1e6));
    if (k.slow_s > 0) usleep((useconds_t)(k.slow_s * 1e6));
    if (k.garbage) {
        code = garbage((double **)p, (double *)m);
    } else if (k.fail_read >= 0 && n >= k.fail_read) {
        code = fail((int)k.error);
    } else {
        pass(k.step_s);
        const double a = k.wrist ? k.turned + k.turn * sin(2 * M_PI * k.hz * now_s) : 0;
        const int i0 = (int)k.axis, i1 = (i0 + 1) % 3, i2 = (i0 + 2) % 3;
        double turned[3][3] = {{0}};
        turned[i0][i0] = 1;
        turned[i1][i1] = turned[i2][i2] = cos(a);
        turned[i1][i2] = -sin(a);
        turned[i2][i1] = sin(a);
        if (k.mirror) turned[0][0] *= -1;
        memcpy(m, turned, sizeof turned);
        for (int i = 0; i < 3; i++) *p[i] = position[i];
    }
    leave();
    return code;
}

/* Documented for devices with a wrist; what it says of the others is left to each. */
int dhdGetPositionAndOrientationFrame(double *px, double *py, double *pz, double m[3][3], char id)
{
    if (k.refuse_frame && !k.wrist) return fail(NOT_AVAILABLE);
    return pose(px, py, pz, m, id);
}
int dhdGetPosition(double *px, double *py, double *pz, char id)
{
    double m[3][3];
    return pose(px, py, pz, m, id);
}

int dhdSetForceAndTorqueAndGripperForce(
    double fx, double fy, double fz, double tx, double ty, double tz, double fg, char id)
{
    if (usable(id)) return -1;
    if (k.regulated) return fail(NOT_AVAILABLE);
    enter();
    const double n = k.writes++;
    int code = 0;
    double norm = sqrt(fx * fx + fy * fy + fz * fz);
    feed();
    k.tx = tx;
    k.ty = ty;
    k.tz = tz;
    if (tx != 0 || ty != 0 || tz != 0) k.torque_sent += 1;
    if (fg != 0) k.gripper_sent += 1;
    if (k.fail_write >= 0 && n >= k.fail_write) {
        code = fail((int)k.error);
    } else if (k.force_on) {
        double most = k.motor_max, scale = 1;
        if (k.max_force > 0 && k.max_force < most) most = k.max_force;
        if (norm > most) { scale = most / norm; code = 2; norm = most; }
        k.fx = fx * scale;
        k.fy = fy * scale;
        k.fz = fz * scale;
        if (norm > k.peak) k.peak = norm;
        note();
    }
    leave();
    return code;
}

__attribute__((constructor)) static void begin(void) { stub_reset(); }
