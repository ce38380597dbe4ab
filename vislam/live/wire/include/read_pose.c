/* How a controller reads the pose: cc -I. read_pose.c -o read_pose && ./read_pose /dev/shm/vislam-pose
 *
 * A line every 10 ms: the pose, or "stop" with the reason. It goes on when `vislam live` is killed and started again.
 */
#include "vislam_pose.h"

#include <stdio.h>

#define OLDEST_NS 100000000 /* choose what your machine may drive blind */

int main(int count, char **arguments) {
    vislam_pose_reader reader = {count > 1 ? arguments[1] : "/dev/shm/vislam-pose", NULL, 0, 0, 0};
    const struct timespec period = {0, 10000000};
    vislam_pose pose;
    for (;;) {
        if (!vislam_pose_latest(&reader, &pose))
            printf("stop: there is no pose\n");
        else if (vislam_pose_age_ns(&pose) > OLDEST_NS)
            printf("stop: the pose is %lld ms old\n", (long long)vislam_pose_age_ns(&pose) / 1000000);
        else if (pose.health & (VISLAM_INVALID | VISLAM_IMU_MISSING))
            printf("stop: health %08x\n", pose.health);
        else
            printf("pose %u: %.3f %.3f %.3f m\n", pose.sequence, pose.position_m[0], pose.position_m[1],
                   pose.position_m[2]);
        fflush(stdout);
        nanosleep(&period, NULL);
    }
}
