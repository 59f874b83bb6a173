/* Falcons behind their serial chips, each with a hand on its knob; usb.c puts them behind libusb.
 *
 * Written from the published packets, boot sequence and dimensions of the device, not from the driver. Each packet of
 * the host moves the knob by a millisecond, so that a run does not depend on the machine, and is answered with the
 * encoders. Device's frame: x to the right, y up, z out to the user; world: x right, y away from the user, z up, from
 * (0, 0, 0.11) of the device.
 */
#ifndef FALCON_H
#define FALCON_H
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { DEVICES = 2, QUEUE = 64, LOGGED = 8192, CHIP = 64, STATUS_BYTES = 2, PACKET = 16, REPLY_MAX = 62 };

#define KNOBS \
 /* what is attached, and to whom */ \
    X(attached, 0) X(held, 0) X(forbidden, 0) X(homed, 1) X(buttons, 0) \
 /* bytes of firmware that it wants first (0: it runs), and tries in which one comes back wrong */ \
    X(firmware, 0) X(spoil, 0) \
 /* motor counts to a N m at a leg, negative where they pull in; the knob and the hand: kg, N s/m, N/m */ \
    X(gain, -10000) X(mass, 0.15) X(bearing, 1.5) X(stiffness, 300) X(damping, 8) \
 /* where the hand is, m, world; how far it goes down in each stroke, and to the side; still: nothing moves */ \
    X(x, 0) X(y, 0) X(z, 0.02) X(press, 0) X(drag, 0) X(still, 0) \
 /* rounds by which a reply is late */ \
    X(late, 0) \
 /* faults: from this packet on (-1 never) it is unplugged, an error on the bus, takes no packet, completes nothing in, \
    is mute; or from now on: takes no packet, does not end what is cancelled, refuses what is \
    submitted with this error; one handling of events takes so long; replies are spoilt in every way; transfers that \
    there is memory for */ \
    X(unplug_at, -1) X(break_at, -1) X(block_at, -1) X(hush_at, -1) X(mute_at, -1) \
    X(block, 0) X(stubborn, 0) X(refuse, 0) X(slow_s, 0) X(fuzz, 0) X(transfers, 16) \
 /* what was done to it, to be read */ \
    X(unplugged, 0) X(opens, 0) X(closes, 0) X(claimed, 0) X(steps, 0) X(forces, 0) X(most, 0) X(m0, 0) X(m1, 0) X(m2, 0) \
    X(state, 0) X(loads, 0) X(requests, 0) X(cancels, 0) X(flying, 0) X(allocated, 0) X(dropped, 0) \
    X(threads, 0) X(misuse, 0) X(logged, 0)

struct falcon {
#define X(name, first) double name;
    KNOBS
#undef X
    double place[3], speed[3];
    bool found[3];
    int zero[3];
    uint8_t stream[PACKET];
    int fill, baud, booting, loaded;
    bool spoilt;
    struct { uint8_t byte[REPLY_MAX]; int size, at; double due; } queue[QUEUE];
    unsigned head, tail;
    double dry;
    double log[LOGGED][6];
    bool waited[LOGGED];
    double came_s[LOGGED];
};
static struct falcon falcon[DEVICES];
static uint64_t noise = 88172645463325252ull;

#define X(name, first) {#name, offsetof(struct falcon, name), first},
static const struct knob { const char *name; size_t at; double first; } knob[] = {KNOBS {0, 0, 0}};
#undef X

static double now_s(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static double *at(int number, const char *name)
{
    for (const struct knob *one = knob; one->name; one++)
        if (!strcmp(one->name, name)) return (double *)((char *)&falcon[number] + one->at);
    fprintf(stderr, "stub: no knob %s\n", name);
    abort();
}

static uint64_t random_bits(void)
{
    noise ^= noise << 13;
    noise ^= noise >> 7;
    noise ^= noise << 17;
    return noise;
}

/* ---- the mechanism: the arms' angles from the triangle of arm, parallelogram and the line between their ends ---- */

static const double CENTRE[3] = {0, 0, 0.11};
static const double LEG[3] = {105, -15, -135};
enum { INDEX = 700 };  /* count of a leg's homing switch, near the end of the knob's way out */

static double leg_angle(int leg, const double p[3])
{
    const double turn = LEG[leg] * M_PI / 180, arm = 0.060;
    const double u = p[0] * cos(turn) + p[1] * sin(turn) - 0.0400 + 0.01443;
    const double v = p[1] * cos(turn) - p[0] * sin(turn) + 0.02309 - 0.025;
    const double reach = 2 * 0.01125 + sqrt(0.1025 * 0.1025 - v * v);  /* the parallelogram leans sideways by v */
    const double line = hypot(u, p[2]);
    return atan2(p[2], u) - acos((arm * arm + line * line - reach * reach) / (2 * arm * line));
}

static double real_count(int leg, const double p[3])
{
    return (leg_angle(leg, p) * 180 / M_PI - 35) / (0.01425 / 0.110 * 360 / 1280);
}

/* Force (N) of the motors on the knob: virtual work, with the angles' change from differences. */
static void force_at(const struct falcon *f, const double p[3], double out[3])
{
    const double h = 1e-6, torque[3] = {f->m0 / f->gain, f->m1 / f->gain, f->m2 / f->gain};
    for (int axis = 0; axis < 3; axis++) {
        double ahead[3] = {p[0], p[1], p[2]}, behind[3] = {p[0], p[1], p[2]};
        ahead[axis] += h;
        behind[axis] -= h;
        out[axis] = 0;
        for (int leg = 0; leg < 3; leg++)
            out[axis] += torque[leg] * (leg_angle(leg, ahead) - leg_angle(leg, behind)) / (2 * h);
    }
    if (f->unplugged) out[0] = out[1] = out[2] = 0;
}

static double smooth(double share) { return 0.5 - 0.5 * cos(M_PI * fmin(fmax(share, 0), 1)); }

/* Where the hand wants the knob: down, to the side and back, up, in 1.2 s; to be homed it first pulls it out. */
static void intention(const struct falcon *f, double time, double out[3])
{
    const double t = fmod(time, 1.2), depth = smooth(t / 0.3) - smooth((t - 0.9) / 0.3);
    const double side = smooth((t - 0.3) / 0.3) - smooth((t - 0.6) / 0.3);
    out[0] = CENTRE[0] + f->x + f->drag * side;
    out[1] = CENTRE[1] + f->z - f->press * depth;
    out[2] = CENTRE[2] - f->y;
    if (!f->homed && time < 2) out[2] += (0.175 - out[2]) * (0.5 - 0.5 * cos(M_PI * time));
}

static void move(struct falcon *f)
{
    enum { SUBSTEPS = 4 };
    const double h = 1e-3 / SUBSTEPS;
    double wanted[3], pull[3];
    force_at(f, f->place, pull);
    intention(f, f->steps * 1e-3, wanted);
    for (int n = 0; n < SUBSTEPS; n++)
        for (int i = 0; i < 3; i++) {
            const double hand = f->stiffness * (wanted[i] - f->place[i]) - (f->damping + f->bearing) * f->speed[i];
            f->speed[i] += h * (pull[i] + hand) / f->mass;
            f->place[i] += h * f->speed[i];
        }
}

/* ---- the device behind its serial chip ---- */

static void queue(struct falcon *f, const uint8_t *byte, int size, double late)
{
    if (f->tail - f->head == QUEUE) return;  /* the chip's buffer is full */
    memcpy(f->queue[f->tail % QUEUE].byte, byte, size);
    f->queue[f->tail % QUEUE].size = size;
    f->queue[f->tail % QUEUE].at = 0;
    f->queue[f->tail++ % QUEUE].due = f->dry + late;
}

static void frame(const int count[3], int bits, uint8_t out[PACKET])
{
    out[0] = '<';
    for (int n = 0; n < 3; n++)
        for (int k = 0; k < 4; k++) out[1 + 4 * n + k] = 'A' + ((count[n] >> (4 * k)) & 15);
    out[13] = 'A' + bits;
    out[14] = 'A';
    out[15] = '>';
}

/* A reply with what may stand before it: noise, noise as long as a packet, a packet with a wrong byte, one cut short.
 * Then comes a whole one, of the true counts or of counts from nowhere. */
static void fuzz(struct falcon *f, const uint8_t packet[PACKET])
{
    uint8_t out[REPLY_MAX];
    int size = 0, count[3];
    for (int k = random_bits() % 8; k > 0; k--) out[size++] = random_bits();
    const int whole = random_bits() % 2 ? PACKET : (int)(random_bits() % PACKET), wrong = random_bits() % PACKET;
    const bool bits = random_bits() % 4 == 0;
    for (int k = 0; k < whole; k++) out[size++] = bits ? (uint8_t)random_bits() : packet[k];
    if (!bits && wrong < whole && wrong != 13) out[size - whole + wrong] ^= 0x80;
    else if (whole == PACKET) size--;
    if (random_bits() % 4 == 0) {
        const int span = random_bits() % 2 ? 65536 : 3000;
        for (int n = 0; n < 3; n++) count[n] = (int)(random_bits() % span) - span / 2;
        frame(count, packet[13] - 'A', out + size);
    } else {
        memcpy(out + size, packet, PACKET);
    }
    queue(f, out, size + PACKET, 0);
}

static void answer(struct falcon *f)
{
    uint8_t packet[PACKET];
    int count[3], bits = (int)f->buttons;
    if (!f->still) move(f);
    f->steps += 1;
    for (int leg = 0; leg < 3; leg++) {
        const int shown = (int)lround(real_count(leg, f->place));
        if ((int)f->state & 1 && shown > INDEX) f->found[leg] = true;
        count[leg] = shown;
    }
    if (f->found[0] && f->found[1] && f->found[2]) memset(f->zero, 0, sizeof f->zero);
    for (int leg = 0; leg < 3; leg++) {
        count[leg] -= f->zero[leg];
        bits |= f->found[leg] << (4 + leg);
    }
    frame(count, bits, packet);
    if (f->mute_at >= 0 && f->steps > f->mute_at) return;
    if (f->fuzz) { fuzz(f, packet); return; }
    queue(f, packet, PACKET, f->late);
}

static void packet_of_host(struct falcon *f)
{
    int count[3];
    for (int n = 0; n < 3; n++) {
        int value = 0;
        for (int k = 0; k < 4; k++) value |= ((f->stream[1 + 4 * n + k] - 'A') & 15) << (4 * k);
        count[n] = (int16_t)value;
        f->most = fmax(f->most, abs(count[n]));
    }
    f->m0 = count[0];
    f->m1 = count[1];
    f->m2 = count[2];
    f->forces += count[0] || count[1] || count[2];
    f->state = f->stream[13] - 'A';
    if (f->logged < LOGGED) {
        double *row = f->log[(int)f->logged];
        force_at(f, f->place, row);
        for (int i = 0; i < 3; i++) row[3 + i] = f->place[i];
        f->waited[(int)f->logged] = false;
        f->came_s[(int)f->logged] = now_s();
        f->logged += 1;
    }
    answer(f);
}

/* The boot loader: a greeting at 9600 baud, 'A' at 140000, then it sends back every byte. */
static void boot(struct falcon *f, const uint8_t *byte, int size)
{
    uint8_t out[REPLY_MAX];
    if (f->booting == 1 && f->baud == 0x4138 && size == 3 && !memcmp(byte, "\nC\r", 3)) {
        f->booting = 2;
        queue(f, (const uint8_t *)"\nD,\r", 4, 0);
    } else if (f->booting == 2 && f->baud == 0x0015 && size == 1 && *byte == 'A') {
        f->booting = 3;
        f->loaded = 0;
        f->spoilt = false;
        queue(f, byte, 1, 0);
    } else if (f->booting == 3 && f->baud == 0x0015 && size <= REPLY_MAX) {
        memcpy(out, byte, size);
        f->loaded += size;
        if (f->loads <= f->spoil && f->loaded > 500) { out[size - 1] ^= 0x10; f->spoilt = true; }
        queue(f, out, size, 0);
    }
}

static void take(struct falcon *f, const uint8_t *byte, int size)
{
    if (f->firmware > 0) { boot(f, byte, size); return; }
    if (f->baud != 0x0002) return;
    for (int k = 0; k < size; k++) {
        f->stream[f->fill++] = byte[k];
        if (f->stream[0] != '<') f->fill = 0;
        if (f->fill < PACKET) continue;
        f->fill = 0;
        bool good = f->stream[15] == '>';
        for (int n = 1; n < 15; n++) good = good && f->stream[n] >= 'A' && f->stream[n] <= 'P';
        if (good) packet_of_host(f); else f->misuse += 1;
    }
}

static int give(struct falcon *f, uint8_t *out, int length)
{
    int size = 0;
    const int most = (int)fmin(62, length - STATUS_BYTES);
    out[0] = 0x01;
    out[1] = 0x60;
    while (f->head != f->tail && f->queue[f->head % QUEUE].due <= f->dry) {
        typeof(&f->queue[0]) first = &f->queue[f->head % QUEUE];
        const int part = (int)fmin(first->size - first->at, most - size);
        memcpy(out + STATUS_BYTES + size, first->byte + first->at, part);
        size += part;
        first->at += part;
        if (first->at < first->size) break;
        f->head++;
    }
    return size;
}

static bool past(const struct falcon *f, double event) { return event >= 0 && f->steps >= event; }
static bool lost(struct falcon *f)
{
    if (past(f, f->unplug_at)) f->unplugged = 1;
    if (f->unplugged) f->m0 = f->m1 = f->m2 = 0;
    return f->unplugged;
}
static bool blocked(const struct falcon *f) { return f->block || past(f, f->block_at); }

#endif
