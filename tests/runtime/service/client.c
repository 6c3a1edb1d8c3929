/* A program in C: agrees on a version, makes a sealed ring, shows one frame, asks how the headset is. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include "hololoop_service.h"

static int service;
static uint32_t serial;

static void fail(const char *what) {
    perror(what);
    exit(1);
}

static void ask(void *message, uint16_t code, size_t bytes, int fd) {
    struct hololoop_header *header = message;
    *header = (struct hololoop_header){code, (uint16_t)bytes, ++serial};
    struct iovec part = {message, bytes};
    union {
        struct cmsghdr align;
        char room[CMSG_SPACE(sizeof(int))];
    } control = {0};
    struct msghdr out = {.msg_iov = &part, .msg_iovlen = 1};
    if (fd >= 0) {
        out.msg_control = &control;
        out.msg_controllen = sizeof control.room;
        struct cmsghdr *passed = CMSG_FIRSTHDR(&out);
        passed->cmsg_level = SOL_SOCKET;
        passed->cmsg_type = SCM_RIGHTS;
        passed->cmsg_len = CMSG_LEN(sizeof(int));
        memcpy(CMSG_DATA(passed), &fd, sizeof fd);
    }
    if (sendmsg(service, &out, 0) != (ssize_t)bytes) fail("send");
}

static void take(void *message, uint16_t code, size_t bytes, uint32_t wanted) {
    static uint64_t room[64];
    struct hololoop_header *header = (struct hololoop_header *)room;
    for (;;) {
        ssize_t got = recv(service, room, sizeof room, 0);
        if (got < (ssize_t)sizeof *header) fail("recv");
        if (header->code == HOLOLOOP_ERROR) {
            fprintf(stderr, "%s\n", ((struct hololoop_error *)room)->text);
            exit(1);
        }
        if (header->code == code && header->serial == wanted && got == (ssize_t)bytes) break;
    }
    memcpy(message, room, bytes);
}

static uint32_t crc32_of(const unsigned char *data, size_t bytes) {
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t k = 0; k < bytes; k++) {
        crc ^= data[k];
        for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320u : 0);
    }
    return ~crc;
}

int main(int count, char **words) {
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    if (count != 2) return 2;
    strncpy(address.sun_path, words[1], sizeof address.sun_path - 1);
    service = socket(AF_UNIX, SOCK_SEQPACKET, 0);
    if (connect(service, (struct sockaddr *)&address, sizeof address)) fail("connect");

    struct hololoop_hello hello = {.lowest = HOLOLOOP_VERSION, .highest = HOLOLOOP_VERSION};
    struct hololoop_welcome welcome;
    memcpy(hello.magic, HOLOLOOP_MAGIC, sizeof hello.magic);
    ask(&hello, HOLOLOOP_HELLO, sizeof hello, -1);
    take(&welcome, HOLOLOOP_WELCOME, sizeof welcome, serial);

    size_t pixels = (size_t)welcome.channels * welcome.height * welcome.width;
    struct hololoop_ring ring = {.slots = 2, .slot_bytes = (uint32_t)(2 * pixels)};
    int memory = memfd_create("frames", MFD_ALLOW_SEALING);
    if (ftruncate(memory, 2 * ring.slot_bytes)) fail("ftruncate");
    if (fcntl(memory, F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW)) fail("seal");
    uint16_t *slots = mmap(NULL, 2 * ring.slot_bytes, PROT_READ | PROT_WRITE, MAP_SHARED, memory, 0);
    if (slots == MAP_FAILED) fail("mmap");
    struct hololoop_plain done;
    ask(&ring, HOLOLOOP_RING, sizeof ring, memory);
    take(&done, HOLOLOOP_DONE, sizeof done, serial);

    struct hololoop_plain wait;
    struct hololoop_timing timing;
    ask(&wait, HOLOLOOP_WAIT, sizeof wait, -1);
    take(&timing, HOLOLOOP_TIMING, sizeof timing, serial);
    struct hololoop_begin begin = {.frame = timing.frame};
    ask(&begin, HOLOLOOP_BEGIN, sizeof begin, -1);
    take(&done, HOLOLOOP_DONE, sizeof done, serial);
    for (size_t k = 0; k < pixels; k++) slots[pixels + k] = (uint16_t)(k * 50);
    struct hololoop_end end = {
        .frame = timing.frame, .slot = 1, .crc = crc32_of((unsigned char *)(slots + pixels), 2 * pixels)};
    ask(&end, HOLOLOOP_END, sizeof end, -1);
    take(&done, HOLOLOOP_DONE, sizeof done, serial);
    struct hololoop_shown shown;
    take(&shown, HOLOLOOP_SHOWN, sizeof shown, 0);

    struct hololoop_plain status;
    struct hololoop_state state;
    ask(&status, HOLOLOOP_STATUS, sizeof status, -1);
    take(&state, HOLOLOOP_STATE, sizeof state, serial);
    printf("%u x %u, frame %u in slot %u, %.1f dB, solver %u\n", welcome.height, welcome.width, shown.frame, shown.slot,
           shown.psnr_db, state.solver);
    return shown.display_ns >= timing.submit_by_ns ? 0 : 1;
}
