/* A stub for libusb-1.0 with two Falcons behind it, of which tests attach as many as they want.
 *
 * Written from libusb's public interface, not from the driver. A transfer is submitted and completes in a later
 * handling of events, by its call back, as in libusb; handling events serves every transfer of the context, whosever it
 * is. Tests steer it through stub_set and stub_get, by the names of KNOBS in falcon.h, and read what it was asked to do.
 *
 * Lateness is counted in dry rounds: handlings of events that completed no transfer in. A driver that reads until
 * nothing is left makes one in each tick, so a reply that is n rounds late is n ticks late, on any machine.
 */
#include <pthread.h>
#include <time.h>
#include <unistd.h>

#include "falcon.h"

enum { FLIGHTS = 16 };
enum { IO = -1, ACCESS = -3, NO_DEVICE = -4, NOT_FOUND = -5, BUSY = -6, TIMED_OUT = -7, NO_MEM = -11,
       NOT_SUPPORTED = -12 };
enum { DONE = 0, BROKEN = 1, CANCELLED = 3, GONE = 5 };

struct libusb_transfer {
    struct handle *dev_handle;
    uint8_t flags;
    unsigned char endpoint, type;
    unsigned timeout;
    int status, length, actual_length;
    void (*callback)(struct libusb_transfer *);
    void *user_data;
    unsigned char *buffer;
    int num_iso_packets;
};

struct handle { int number; bool claimed; };
struct flight { struct libusb_transfer *transfer; bool taken, cancelled; double since; };

static struct flight flight[FLIGHTS];
static pthread_mutex_t guard = PTHREAD_MUTEX_INITIALIZER;
static volatile int inside;

/* ---- what tests call ---- */

void stub_set(int number, const char *name, double value)
{
    pthread_mutex_lock(&guard);
    *at(number, name) = value;
    pthread_mutex_unlock(&guard);
}
double stub_get(int number, const char *name) { return *at(number, name); }
/* Every knob as at first, the hand where `intention` has it; transfers under way are forgotten. */
void stub_reset(void)
{
    pthread_mutex_lock(&guard);
    memset(flight, 0, sizeof flight);
    memset(falcon, 0, sizeof falcon);
    for (int n = 0; n < DEVICES; n++)
        for (const struct knob *one = knob; one->name; one++) *at(n, one->name) = one->first;
    falcon[0].attached = 1;
    pthread_mutex_unlock(&guard);
}
/* Put the knob where the hand is; after the knobs are set. */
void stub_place(int number)
{
    struct falcon *f = &falcon[number];
    intention(f, 0, f->place);
    memset(f->speed, 0, sizeof f->speed);
    for (int leg = 0; leg < 3; leg++) {
        f->found[leg] = f->homed != 0;
        f->zero[leg] = f->homed ? 0 : (int)lround(real_count(leg, f->place));
    }
}
/* Force (N) on the hand and place (m) of the knob now, in the world's frame. */
void stub_state(int number, double out[6])
{
    const struct falcon *f = &falcon[number];
    double force[3];
    force_at(f, f->place, force);
    out[0] = force[0];
    out[1] = -force[2];
    out[2] = force[1];
    out[3] = f->place[0] - CENTRE[0];
    out[4] = CENTRE[2] - f->place[2];
    out[5] = f->place[1] - CENTRE[1];
}
/* Of each packet taken since `logged` was 0: force on the hand when it came and place, as stub_state has them, and
 * whether the host then waited: a loop that was held up asks anew, and no packet of a tick is waited for. */
int stub_log(int number, double *out, int rows)
{
    const struct falcon *f = &falcon[number];
    if (rows > (int)f->logged) rows = (int)f->logged;
    for (int n = 0; n < rows; n++, out += 7) {
        const double *row = f->log[n];
        const double turned[7] = {row[0], -row[2], row[1], row[3] - CENTRE[0], CENTRE[2] - row[5], row[4] - CENTRE[1],
                                  f->waited[n]};
        memcpy(out, turned, sizeof turned);
    }
    return rows;
}
/* And when each came, s of the monotonic clock. */
void stub_times(int number, double *out, int rows) { memcpy(out, falcon[number].came_s, rows * sizeof *out); }
int stub_busy(void) { return inside; }

/* `ticks` ticks of a driver's exchange against a device that spoils its replies, with a force in each. seen[]: statuses
 * 0, 1, below 0; places; samples that are no number; forces after such a one; places whose counts the device did not
 * send; samples partly a number; status 3, after a pause of this loop. A place is checked with this file's own inverse
 * kinematics. */
void stub_fuzz(int64_t (*read)(int64_t, double *), int64_t (*write)(int64_t, double *), int64_t block, int64_t counts_at,
               int size, int ticks, int64_t seen[9])
{
    double sample[32] = {0}, force[6] = {0.3, -0.2, 0.5, 0, 0, 0};
    struct falcon *f = &falcon[0];
    if (size > 32) abort();
    for (int n = 0; n < ticks; n++) {
        const int64_t status = read(block, sample);
        seen[status < 0 ? 2 : status == 3 ? 8 : status]++;
        const int finite = !!isfinite(sample[0]) + !!isfinite(sample[1]) + !!isfinite(sample[2]);
        if (finite == 3) {
            const double p[3] = {sample[0] + CENTRE[0], sample[2] + CENTRE[1], CENTRE[2] - sample[1]};
            seen[3]++;
            for (int leg = 0; leg < 3; leg++)
                if (!(fabs(real_count(leg, p) - (double)((int64_t *)counts_at)[leg]) < 1e-6)) { seen[6]++; break; }
        } else {
            seen[finite ? 7 : 4]++;
        }
        const int64_t taken = write(block, force);
        if (taken < 0) seen[2]++;
        if (finite != 3 && (f->m0 || f->m1 || f->m2)) seen[5]++;
    }
}

/* ---- libusb ---- */

struct device_descriptor {
    uint8_t bLength, bDescriptorType;
    uint16_t bcdUSB;
    uint8_t bDeviceClass, bDeviceSubClass, bDeviceProtocol, bMaxPacketSize0;
    uint16_t idVendor, idProduct, bcdDevice;
    uint8_t iManufacturer, iProduct, iSerialNumber, bNumConfigurations;
};
struct endpoint_descriptor {
    uint8_t bLength, bDescriptorType, bEndpointAddress, bmAttributes;
    uint16_t wMaxPacketSize;
    uint8_t bInterval, bRefresh, bSynchAddress;
    const unsigned char *extra;
    int extra_length;
};
struct interface_descriptor {
    uint8_t bLength, bDescriptorType, bInterfaceNumber, bAlternateSetting, bNumEndpoints, bInterfaceClass,
        bInterfaceSubClass, bInterfaceProtocol, iInterface;
    const struct endpoint_descriptor *endpoint;
    const unsigned char *extra;
    int extra_length;
};
struct interface { const struct interface_descriptor *altsetting; int num_altsetting; };
struct config_descriptor {
    uint8_t bLength, bDescriptorType;
    uint16_t wTotalLength;
    uint8_t bNumInterfaces, bConfigurationValue, iConfiguration, bmAttributes, MaxPower;
    const struct interface *interface;
    const unsigned char *extra;
    int extra_length;
};
static const struct endpoint_descriptor ends[2] = {
    {7, 5, 0x81, 2, CHIP, 0, 0, 0, 0, 0}, {7, 5, 0x02, 2, CHIP, 0, 0, 0, 0, 0}};
static const struct interface_descriptor alternate = {9, 4, 0, 0, 2, 255, 255, 255, 0, ends, 0, 0};
static const struct interface one_interface = {&alternate, 1};
static const struct config_descriptor config = {9, 2, 32, 1, 1, 0, 0x80, 45, &one_interface, 0, 0};

static int number_of(const void *dev) { return (int)((const struct falcon *)dev - falcon); }
static struct falcon *behind(const struct handle *h) { return &falcon[h->number]; }

int libusb_init(void **ctx) { if (ctx) *ctx = falcon; return 0; }
void libusb_exit(void *ctx) { (void)ctx; }
void libusb_set_debug(void *ctx, int level) { (void)ctx; (void)level; }
const char *libusb_strerror(int code) { return code == NO_DEVICE ? "No such device (it may have been disconnected)" : "stub"; }
long libusb_get_device_list(void *ctx, void ***list)
{
    long count = 0;
    (void)ctx;
    *list = calloc(DEVICES + 1, sizeof **list);
    for (int n = 0; n < DEVICES; n++)
        if (falcon[n].attached && !falcon[n].unplugged) (*list)[count++] = &falcon[n];
    return count;
}
void libusb_free_device_list(void **list, int unref) { (void)unref; free(list); }
void *libusb_ref_device(void *dev) { return dev; }
void libusb_unref_device(void *dev) { (void)dev; }
void *libusb_get_parent(void *dev) { (void)dev; return 0; }
int libusb_get_device_descriptor(void *dev, struct device_descriptor *out)
{
    (void)dev;
    *out = (struct device_descriptor){18, 1, 0x0200, 0, 0, 0, 8, 0x0403, 0xCB48, 0x0400, 1, 2, 3, 1};
    return 0;
}
int libusb_get_config_descriptor(void *dev, uint8_t index, const struct config_descriptor **out)
{
    (void)dev;
    *out = &config;
    return index ? NOT_FOUND : 0;
}
void libusb_free_config_descriptor(const struct config_descriptor *one) { (void)one; }
uint8_t libusb_get_bus_number(void *dev) { (void)dev; return 1; }
uint8_t libusb_get_device_address(void *dev) { return 5 + number_of(dev); }
int libusb_get_device_speed(void *dev) { (void)dev; return 2; }
uint8_t libusb_get_port_number(void *dev) { return 1 + number_of(dev); }
int libusb_get_port_numbers(void *dev, uint8_t *out, int length)
{
    if (length < 1) return NO_MEM;
    *out = 1 + number_of(dev);
    return 1;
}
int libusb_get_max_iso_packet_size(void *dev, unsigned char end) { (void)dev; (void)end; return NOT_FOUND; }
int libusb_open(void *dev, struct handle **out)
{
    struct falcon *f = dev;
    if (lost(f)) return NO_DEVICE;
    if (f->forbidden) return ACCESS;
    f->opens += 1;
    *out = calloc(1, sizeof **out);
    (*out)->number = number_of(dev);
    return 0;
}
void libusb_close(struct handle *h)
{
    struct falcon *f = behind(h);
    pthread_mutex_lock(&guard);
    f->closes += 1;
    if (h->claimed) f->claimed = 0;
    for (int n = 0; n < FLIGHTS; n++)  /* what is still under way is taken from its owner */
        if (flight[n].transfer && flight[n].transfer->dev_handle == h) {
            flight[n].transfer = 0;
            f->flying -= 1;
            f->dropped += 1;
        }
    pthread_mutex_unlock(&guard);
    free(h);
}
int libusb_set_configuration(struct handle *h, int value) { (void)h; (void)value; return 0; }
int libusb_get_configuration(struct handle *h, int *out) { (void)h; *out = 1; return 0; }
int libusb_set_interface_alt_setting(struct handle *h, int i, int a) { (void)h; (void)i; (void)a; return 0; }
int libusb_claim_interface(struct handle *h, int number)
{
    (void)number;
    if (lost(behind(h))) return NO_DEVICE;
    if (behind(h)->held || (behind(h)->claimed && !h->claimed)) return BUSY;
    behind(h)->claimed = h->claimed = true;
    return 0;
}
int libusb_release_interface(struct handle *h, int number)
{
    (void)number;
    if (h->claimed) behind(h)->claimed = 0;
    h->claimed = false;
    return behind(h)->unplugged ? NO_DEVICE : 0;
}
int libusb_reset_device(struct handle *h) { (void)h; return 0; }
int libusb_kernel_driver_active(struct handle *h, int number) { (void)h; (void)number; return 0; }
int libusb_detach_kernel_driver(struct handle *h, int number) { (void)h; (void)number; return 0; }
int libusb_attach_kernel_driver(struct handle *h, int number) { (void)h; (void)number; return 0; }
int libusb_clear_halt(struct handle *h, unsigned char end) { (void)h; (void)end; return 0; }
int libusb_get_string_descriptor_ascii(struct handle *h, uint8_t i, unsigned char *out, int length)
{
    (void)h; (void)i; (void)out; (void)length;
    return NOT_SUPPORTED;
}
static int text(int number, int index, unsigned char *out, int length)
{
    const char *const texts[] = {"", "FTDI", "FALCON HAPTIC", number ? "SN2" : "SN1"};
    unsigned char made[64] = {4, 3, 9, 4};
    if (index > 3) return IO;
    if (index) {
        made[0] = 2 + 2 * strlen(texts[index]);
        memset(made + 2, 0, sizeof made - 2);
        for (int k = 0; texts[index][k]; k++) made[2 + 2 * k] = texts[index][k];
    }
    if (length > made[0]) length = made[0];
    memcpy(out, made, length);
    return length;
}
int libusb_control_transfer(struct handle *h, uint8_t kind, uint8_t request, uint16_t value, uint16_t index,
                            unsigned char *data, uint16_t length, unsigned timeout)
{
    struct falcon *f = behind(h);
    (void)timeout;
    if (lost(f)) return NO_DEVICE;
    if (kind == 0x80 && request == 6 && value >> 8 == 3) return text(h->number, value & 255, data, length);
    if (kind != 0x40 || index || length) { f->misuse += 1; return IO; }
    f->requests += 1;
    if (request == 0 && value == 1) f->head = f->tail;
    if (request == 1 && value == 0x0101 && f->firmware > 0) { f->booting = 1; f->loads += 1; }
    if (request == 3) {
        f->baud = value;
        if (value == 0x0002 && f->booting == 3 && f->loaded == f->firmware && !f->spoilt) f->firmware = 0;
    }
    return 0;
}
int libusb_bulk_transfer(
    struct handle *h, unsigned char end, unsigned char *data, int length, int *transferred, unsigned timeout)
{
    struct falcon *f = behind(h);
    int code = 0;
    (void)timeout;
    *transferred = 0;
    pthread_mutex_lock(&guard);
    if (lost(f)) {
        code = NO_DEVICE;
    } else if (!h->claimed) {
        f->misuse += 1;
        code = IO;
    } else if (end & 0x80) {
        f->dry += 1;
        *transferred = STATUS_BYTES + give(f, data, length);
    } else if (blocked(f)) {
        code = TIMED_OUT;
    } else {
        take(f, data, length);
        *transferred = length;
    }
    pthread_mutex_unlock(&guard);
    return code;
}
int libusb_interrupt_transfer(
    struct handle *h, unsigned char end, unsigned char *data, int length, int *transferred, unsigned timeout)
{
    (void)h; (void)end; (void)data; (void)length; (void)transferred; (void)timeout;
    return NOT_SUPPORTED;
}

struct libusb_transfer *libusb_alloc_transfer(int packets)
{
    (void)packets;
    if (falcon[0].allocated >= falcon[0].transfers) return 0;
    falcon[0].allocated += 1;
    return calloc(1, sizeof(struct libusb_transfer));
}
static struct flight *flying(const struct libusb_transfer *transfer)
{
    for (int n = 0; n < FLIGHTS; n++)
        if (flight[n].transfer == transfer) return &flight[n];
    return 0;
}
void libusb_free_transfer(struct libusb_transfer *transfer)
{
    if (!transfer) return;
    if (flying(transfer)) { falcon[0].misuse += 1; return; }
    falcon[0].allocated -= 1;
    memset(transfer, 0xEE, sizeof *transfer);  /* whoever uses it still finds nonsense */
    free(transfer);
}
int libusb_submit_transfer(struct libusb_transfer *transfer)
{
    struct falcon *f = behind(transfer->dev_handle);
    int code = 0;
    pthread_mutex_lock(&guard);
    struct flight *free_one = flying(0);
    if (flying(transfer) || !free_one || !transfer->dev_handle->claimed) { f->misuse += 1; code = BUSY; }
    else if (lost(f)) code = NO_DEVICE;
    else if (f->refuse) code = (int)f->refuse;
    if (!code) {
        *free_one = (struct flight){transfer, false, false, now_s()};
        f->flying += 1;
        if (transfer->endpoint == 0x02 && !blocked(f)) {
            free_one->taken = true;
            take(f, transfer->buffer, transfer->length);
        }
    }
    pthread_mutex_unlock(&guard);
    return code;
}
int libusb_cancel_transfer(struct libusb_transfer *transfer)
{
    struct flight *one;
    int code = NOT_FOUND;
    pthread_mutex_lock(&guard);
    if ((one = flying(transfer)) && !one->cancelled) {
        behind(transfer->dev_handle)->cancels += 1;
        one->cancelled = true;
        code = 0;
    }
    pthread_mutex_unlock(&guard);
    return code;
}

/* Status with which a transfer ends now, or -1 while it is under way. */
static int ending(struct flight *one)
{
    struct libusb_transfer *transfer = one->transfer;
    struct falcon *f = behind(transfer->dev_handle);
    transfer->actual_length = 0;
    if (lost(f)) return GONE;
    if (past(f, f->break_at)) return BROKEN;
    if (one->cancelled && !f->stubborn && !one->taken) return CANCELLED;
    if (transfer->endpoint == 0x02) {
        if (!one->taken && (blocked(f) || one->cancelled)) return -1;
        if (!one->taken) take(f, transfer->buffer, transfer->length);
        transfer->actual_length = transfer->length;
        return DONE;
    }
    if (one->cancelled || past(f, f->hush_at)) return -1;
    const int size = give(f, transfer->buffer, transfer->length);
    if (size == 0 && now_s() - one->since < 1e-3) return -1;  /* the chip's latency */
    transfer->actual_length = STATUS_BYTES + size;
    return DONE;
}
static int complete_what_is_done(bool in[DEVICES])
{
    struct libusb_transfer *ended[FLIGHTS];
    int count = 0;
    pthread_mutex_lock(&guard);
    for (int n = 0; n < FLIGHTS; n++) {
        struct libusb_transfer *transfer = flight[n].transfer;
        if (!transfer) continue;
        const int status = ending(&flight[n]);
        if (status < 0) continue;
        transfer->status = status;
        flight[n].transfer = 0;
        behind(transfer->dev_handle)->flying -= 1;
        if (transfer->endpoint & 0x80) in[transfer->dev_handle->number] = true;
        ended[count++] = transfer;
    }
    pthread_mutex_unlock(&guard);
    for (int n = 0; n < count; n++) ended[n]->callback(ended[n]);
    return count;
}
int libusb_handle_events_timeout_completed(void *ctx, struct timeval *wait, int *completed)
{
    struct falcon *f = &falcon[0];
    bool in[DEVICES] = {false};
    (void)ctx;
    (void)completed;
    if (__sync_fetch_and_add(&inside, 1) && !falcon[1].attached) f->threads += 1;
    if (wait->tv_usec > 0)
        for (int n = 0; n < DEVICES; n++)
            if (falcon[n].logged > 0 && falcon[n].logged <= LOGGED) falcon[n].waited[(int)falcon[n].logged - 1] = true;
    const double until = now_s() + wait->tv_sec + 1e-6 * wait->tv_usec;
    if (f->slow_s > 0) { usleep((useconds_t)(f->slow_s * 1e6)); f->slow_s = 0; }
    while (!complete_what_is_done(in) && now_s() < until) usleep(20);
    for (int n = 0; n < DEVICES; n++)
        if (!in[n]) falcon[n].dry += 1;
    __sync_fetch_and_sub(&inside, 1);
    return 0;
}
int libusb_handle_events(void *ctx)
{
    struct timeval wait = {60, 0};
    return libusb_handle_events_timeout_completed(ctx, &wait, 0);
}

__attribute__((constructor)) static void begin(void)
{
    stub_reset();
    for (int n = 0; n < DEVICES; n++) stub_place(n);
}
