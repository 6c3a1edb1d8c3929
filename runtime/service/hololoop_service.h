/* The protocol of hololoop's service, version 1, for C programs.
 *
 * Connect a SOCK_SEQPACKET socket of AF_UNIX to the service's path. Each message is one of these structs, sent and
 * received whole; all numbers are little-endian. Their order (protocol.py, in the same folder, describes it in full):
 *
 *   HELLO            -> WELCOME
 *   RING + memfd     -> DONE        memfd_create(MFD_ALLOW_SEALING), ftruncate, F_ADD_SEALS of SHRINK and GROW
 *   WAIT             -> TIMING      when the next frame may begin
 *   BEGIN            -> DONE
 *   END              -> DONE        accepted; later, with serial 0: SHOWN, or ERROR with the frame's number
 *   CLEAR, ARM, DARK -> DONE        the lasers
 *   STATUS           -> STATE
 *   CAPTURE          -> PICTURE + memfd
 *   REFINE           -> DONE        later, with serial 0: REFINED
 *
 * Any request may be answered by ERROR. Where recv fails with ECONNRESET, call it once more: the service closed the
 * connection without reading all, and what it had sent, such as the ERROR that says why, is still to come.
 *
 * Times are CLOCK_MONOTONIC in ns. A slot of the ring holds linear irradiance, uint16_t [channels][height][width],
 * 65535 for the brightest; `crc` is zlib's crc32 of its bytes.
 */
#ifndef HOLOLOOP_SERVICE_H
#define HOLOLOOP_SERVICE_H

#include <stdint.h>

#define HOLOLOOP_VERSION 1
#define HOLOLOOP_MAGIC "hololoop" /* 8 bytes, without the zero */
#define HOLOLOOP_MOST_SLOTS 16

enum hololoop_message {
    HOLOLOOP_HELLO = 1,
    HOLOLOOP_WELCOME = 2,
    HOLOLOOP_RING = 3,
    HOLOLOOP_DONE = 4,
    HOLOLOOP_ERROR = 5,
    HOLOLOOP_WAIT = 6,
    HOLOLOOP_TIMING = 7,
    HOLOLOOP_BEGIN = 8,
    HOLOLOOP_END = 9,
    HOLOLOOP_SHOWN = 10,
    HOLOLOOP_STATUS = 11,
    HOLOLOOP_STATE = 12,
    HOLOLOOP_CLEAR = 13,
    HOLOLOOP_ARM = 14,
    HOLOLOOP_DARK = 15,
    HOLOLOOP_CAPTURE = 16,
    HOLOLOOP_PICTURE = 17,
    HOLOLOOP_REFINE = 18,
    HOLOLOOP_REFINED = 19
};

enum hololoop_part { HOLOLOOP_ABSENT = 0, HOLOLOOP_FRESH = 1, HOLOLOOP_STALE = 2, HOLOLOOP_LOST = 3 };

enum hololoop_lasers {
    HOLOLOOP_LASERS_OFF = 0,
    HOLOLOOP_LASERS_ARMED = 1,
    HOLOLOOP_LASERS_EMITTING = 2,
    HOLOLOOP_LASERS_FAULT = 3,
    HOLOLOOP_LASERS_LOST = 4
};

enum hololoop_flags { HOLOLOOP_LATE = 1, HOLOLOOP_UNFINISHED = 2 };

enum hololoop_code {
    HOLOLOOP_MALFORMED = 1,
    HOLOLOOP_WRONG_VERSION = 2,
    HOLOLOOP_WRONG_ORDER = 3,
    HOLOLOOP_WRONG_RING = 4,
    HOLOLOOP_WRONG_SLOT = 5,
    HOLOLOOP_TORN = 6,
    HOLOLOOP_BUSY = 7,
    HOLOLOOP_NO_SOLVER = 8,
    HOLOLOOP_NO_PANEL = 9,
    HOLOLOOP_NO_LASERS = 10,
    HOLOLOOP_NO_CAMERA = 11,
    HOLOLOOP_REFUSED = 12,
    HOLOLOOP_STOPPING = 13
};

/* The first bytes of every message. A request's serial is above 0; its answer repeats it. */
struct hololoop_header {
    uint16_t code;
    uint16_t bytes; /* of the whole message */
    uint32_t serial;
};

struct hololoop_hello {
    struct hololoop_header header;
    char magic[8];
    uint16_t lowest; /* versions that the program supports */
    uint16_t highest;
    uint32_t reserved;
};

struct hololoop_welcome {
    struct hololoop_header header;
    uint16_t version;
    uint16_t channels;
    uint32_t height;
    uint32_t width;
    uint32_t period_us;
    uint32_t stale_limit_us;
    uint32_t most_slots;
};

struct hololoop_ring {
    struct hololoop_header header;
    uint32_t slots;
    uint32_t slot_bytes;
};

/* DONE, WAIT, STATUS, CLEAR, ARM, DARK and CAPTURE. */
struct hololoop_plain {
    struct hololoop_header header;
};

struct hololoop_error {
    struct hololoop_header header;
    uint32_t code;
    uint32_t frame; /* above 0: this accepted frame was not shown */
    char text[240]; /* UTF-8, ends with a zero */
};

struct hololoop_timing {
    struct hololoop_header header;
    uint64_t display_ns;
    uint64_t submit_by_ns;
    uint32_t frame;
    uint32_t period_us;
};

struct hololoop_begin {
    struct hololoop_header header;
    uint32_t frame;
    uint32_t reserved;
};

struct hololoop_end {
    struct hololoop_header header;
    uint32_t frame;
    uint32_t slot;
    uint32_t crc;
    uint32_t reserved;
};

struct hololoop_shown {
    struct hololoop_header header;
    uint64_t display_ns;
    uint32_t frame;
    uint32_t slot;
    float psnr_db;
    uint32_t flags;
    uint32_t pattern_crc;
    uint32_t reserved;
};

struct hololoop_state {
    struct hololoop_header header;
    uint64_t time_ns;
    uint64_t shown;
    uint64_t late;
    uint64_t failed;
    uint32_t lasers;
    uint32_t laser_faults;
    uint32_t panel;
    uint32_t solver;
    uint32_t camera;
    uint32_t faults;
};

struct hololoop_picture {
    struct hololoop_header header;
    uint64_t time_ns;
    uint32_t height;
    uint32_t width;
    uint32_t bit_depth;
    uint32_t exposure_us;
};

struct hololoop_refine {
    struct hololoop_header header;
    uint32_t captures; /* at most; 0: end a refinement and go back to the solver's own pattern */
    uint32_t reserved;
};

struct hololoop_refined {
    struct hololoop_header header;
    uint32_t captures;
    float first_psnr_db; /* of amplitude, of the captured picture */
    float best_psnr_db;
    char text[240]; /* why it has ended; UTF-8, ends with a zero */
};

#endif
