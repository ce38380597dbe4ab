/* The pose that `vislam live` publishes: in shared memory (/dev/shm/NAME), and as one datagram per inertial sample.
 *
 * Little-endian, 256 bytes, no padding; docs/cart.md explains the fields. Check magic, version, size and crc32, then
 * the health word: a controller must not steer by a pose with VISLAM_INVALID or VISLAM_IMU_MISSING set, nor by an old
 * one: where `vislam live` was killed, the last pose stays. Use vislam_pose_latest, which follows a restarted one, and
 * look at the age; read_pose.c does.
 */
#ifndef VISLAM_POSE_H
#define VISLAM_POSE_H

#if !defined(_POSIX_C_SOURCE) && !defined(_GNU_SOURCE)
#define _POSIX_C_SOURCE 200809L
#endif
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#ifndef CLOCK_MONOTONIC
#error "include vislam_pose.h first, or define _POSIX_C_SOURCE 200809L"
#endif
#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "poses are little-endian"
#endif

#define VISLAM_POSE_MAGIC 0x4F505356u /* "VSPO" */
#define VISLAM_POSE_VERSION 1
#define VISLAM_NO_VISION_MS 0xFFFFu

enum vislam_health {
    VISLAM_LEVELLED = 1u << 0,          /* gravity is known */
    VISLAM_VISION_OK = 1u << 1,         /* vision, or without a camera further sensors, correct the filter */
    VISLAM_DEAD_RECKONING = 1u << 2,    /* nothing of that */
    VISLAM_INVALID = 1u << 3,           /* do not steer by it */
    VISLAM_AT_REST = 1u << 4,
    VISLAM_MAG_OK = 1u << 5,
    VISLAM_GATE_REJECT = 1u << 6,       /* vision contradicts the filter now */
    VISLAM_DOUBTFUL = 1u << 7,          /* the run so far contradicts itself */
    VISLAM_NOT_IN_MAP = 1u << 8,        /* map_odom is a guess */
    VISLAM_IMU_MISSING = 1u << 16,
    VISLAM_IMU_GAP = 1u << 17,
    VISLAM_ACCEL_SATURATED = 1u << 18,
    VISLAM_GYRO_SATURATED = 1u << 19,
    VISLAM_ACCEL_FAULT = 1u << 20,
    VISLAM_GYRO_FAULT = 1u << 21,
    VISLAM_MAG_FAULT = 1u << 22,
    VISLAM_BUS_FAULT = 1u << 23,
    VISLAM_TEMPERATURE_DRIFT = 1u << 24,
    VISLAM_CLOCK_STEP = 1u << 25,
    VISLAM_CAMERA_MISSING = 1u << 26
};

typedef struct vislam_pose {
    uint32_t magic;
    uint16_t version;
    uint16_t size;                      /* 256 */
    uint32_t sequence;                  /* one more with each */
    uint32_t health;                    /* enum vislam_health */
    int64_t stamp_sample_ns;            /* CLOCK_MONOTONIC of the inertial sample */
    int64_t stamp_publish_ns;           /* CLOCK_MONOTONIC */
    double position_m[3];               /* base in odom */
    float orientation_xyzw[4];          /* base to odom */
    float velocity_m_s[3];              /* of the base, in its own axes */
    float rate_rad_s[3];                /* in axes of the base */
    float pose_covariance[21];          /* upper triangle by rows: x, y, z, rotation about X, Y, Z of odom */
    float velocity_covariance[6];       /* upper triangle by rows, axes of the base */
    float rate_variance[3];             /* axes of the base */
    float map_odom_position_m[3];       /* odom in map; jumps when a loop closes */
    float map_odom_orientation_xyzw[4]; /* odom to map */
    uint32_t map_revision;              /* 0: map and odom coincide */
    uint16_t reset_counter;
    uint16_t vision_age_ms;             /* VISLAM_NO_VISION_MS: never, or longer ago */
    uint32_t crc32;                     /* of the 252 bytes before; polynomial 0xEDB88320, as in zlib */
} vislam_pose;

typedef struct vislam_pose_slot {       /* what is mapped from shared memory */
    uint64_t sequence;                  /* written last */
    uint32_t length;
    uint32_t crc32;                     /* of the pose's 256 bytes */
    vislam_pose pose;
    uint64_t sequence_first;            /* written first */
} vislam_pose_slot;

#ifdef __cplusplus
#define VISLAM_ASSERT(fact) static_assert(fact, #fact)
#else
#define VISLAM_ASSERT(fact) _Static_assert(fact, #fact)
#endif
VISLAM_ASSERT(sizeof(vislam_pose) == 256);
VISLAM_ASSERT(offsetof(vislam_pose, position_m) == 32);
VISLAM_ASSERT(offsetof(vislam_pose, pose_covariance) == 96);
VISLAM_ASSERT(offsetof(vislam_pose, crc32) == 252);
VISLAM_ASSERT(sizeof(vislam_pose_slot) == 280);
VISLAM_ASSERT(offsetof(vislam_pose_slot, pose) == 16);

static inline uint32_t vislam_crc32(const void *data, size_t length) {
    const uint8_t *bytes = (const uint8_t *)data;
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t i = 0; i < length; ++i) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; ++bit) crc = (crc >> 1) ^ (0xEDB88320u & (0u - (crc & 1u)));
    }
    return ~crc;
}

/* Whether 256 bytes, from a datagram or a slot, are a sound pose. */
static inline int vislam_pose_is_sound(const vislam_pose *pose) {
    return pose->magic == VISLAM_POSE_MAGIC && pose->version == VISLAM_POSE_VERSION &&
           pose->size == sizeof(vislam_pose) && vislam_crc32(pose, offsetof(vislam_pose, crc32)) == pose->crc32;
}

/* Map /dev/shm/NAME; NULL where it is not there, too small, or others than this user, root and `owner` may write to it.
 *
 * `owner` is the user whose `vislam live --live.group GROUP` lets this one read; 0 names none. */
static inline const vislam_pose_slot *vislam_pose_open_of(const char *path, uid_t owner) {
    struct stat found;
    void *memory = MAP_FAILED;
    int file = open(path, O_RDONLY | O_NOFOLLOW);
    if (file < 0) return NULL;
    if (fstat(file, &found) == 0 && S_ISREG(found.st_mode) && (found.st_mode & (S_IWGRP | S_IWOTH)) == 0 &&
        (found.st_uid == geteuid() || found.st_uid == owner || found.st_uid == 0) &&
        found.st_size >= (off_t)sizeof(vislam_pose_slot))
        memory = mmap(NULL, sizeof(vislam_pose_slot), PROT_READ, MAP_SHARED, file, 0);
    close(file);
    return memory == MAP_FAILED ? NULL : (const vislam_pose_slot *)memory;
}

static inline const vislam_pose_slot *vislam_pose_open(const char *path) {
    return vislam_pose_open_of(path, 0);
}

/* Copy the newest pose out of shared memory; 0 when there is none yet, or the writer was in between (try again). */
static inline int vislam_pose_read(const volatile vislam_pose_slot *slot, vislam_pose *out) {
    uint64_t sequence = slot->sequence;
    __sync_synchronize();
    memcpy(out, (const void *)&slot->pose, sizeof *out);
    __sync_synchronize();
    return sequence != 0 && slot->sequence_first == sequence && vislam_pose_is_sound(out);
}

/* Nanoseconds since a pose was published, by the clock of this machine. */
static inline int64_t vislam_pose_age_ns(const vislam_pose *pose) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec - pose->stamp_publish_ns;
}

typedef struct vislam_pose_reader {     /* begin with {.path = "/dev/shm/vislam-pose"}, the rest 0 */
    const char *path;
    const vislam_pose_slot *slot;       /* NULL: nothing is mapped */
    dev_t device;                       /* of what is mapped */
    ino_t inode;
    uid_t owner;                        /* whose pose is read, besides this user's and root's; see vislam_pose_open_of */
} vislam_pose_reader;

/* Let go of the memory; vislam_pose_latest maps it again. */
static inline void vislam_pose_close(vislam_pose_reader *reader) {
    if (reader->slot != NULL) munmap((void *)reader->slot, sizeof *reader->slot);
    reader->slot = NULL;
}

/* Copy the newest pose, of the writer that has the name now; 0 as vislam_pose_read, or when there is no writer yet.
 *
 * One call of stat more than vislam_pose_read. After the writer has gone, its last pose comes again and again. */
static inline int vislam_pose_latest(vislam_pose_reader *reader, vislam_pose *out) {
    struct stat found;
    int is_there = stat(reader->path, &found) == 0;
    if (is_there && (reader->slot == NULL || found.st_ino != reader->inode || found.st_dev != reader->device)) {
        const vislam_pose_slot *slot = vislam_pose_open_of(reader->path, reader->owner);
        if (slot != NULL) {             /* of a still newer writer, if it came in between: then mapped once more */
            vislam_pose_close(reader);
            reader->slot = slot;
            reader->device = found.st_dev;
            reader->inode = found.st_ino;
        }
    }
    return reader->slot != NULL && vislam_pose_read(reader->slot, out);
}

#endif
