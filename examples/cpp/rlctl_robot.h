/* The UDP protocol of `rlctl robot`: one packed struct, little-endian, in both directions.
 *
 *   program -> robot   HELLO, repeated until a measurement comes; after the header the key, if the robot needs one
 *   robot -> program   MEASUREMENT (with --controller): the inputs of `rlctl export --controller`, in the order of the
 *                      members of controller_inputs; or OBSERVATION (without): the policy's observation, as in the
 *                      header of `rlctl export --c`. Sent again after 0.25 s if no answer has come, with the same
 *                      sequence: a program with a memory then repeats its answer and does not act again
 *   program -> robot   COMMAND: the header of what came with this kind, and the controller's targets (its actions, where
 *                      the task has no targets); for an observation the action
 *                      NO_COMMAND, without values: the command before acts again
 *   robot -> program   END: the test is over
 *
 * A packet has the header and as many values as its kind has; the values after them are not sent.
 */
#ifndef RLCTL_ROBOT_H
#define RLCTL_ROBOT_H

#include <stdint.h>

#define RLCTL_ROBOT_MAGIC 0x52434c52u /* the bytes "RLCR" */
#define RLCTL_ROBOT_VERSION 2
#define RLCTL_ROBOT_MAX_VALUES 1024
#define RLCTL_ROBOT_HEADER_SIZE 48 /* [bytes] */

enum {
    RLCTL_ROBOT_HELLO = 1,
    RLCTL_ROBOT_OBSERVATION = 2,
    RLCTL_ROBOT_MEASUREMENT = 3,
    RLCTL_ROBOT_COMMAND = 4,
    RLCTL_ROBOT_NO_COMMAND = 5,
    RLCTL_ROBOT_END = 6
};

#pragma pack(push, 1)
typedef struct {
    uint32_t magic;
    uint16_t version;
    uint16_t kind;
    uint64_t session;       /* drawn by the robot; answers repeat it */
    double time_s;          /* when it was measured, from the start of the episode, on the robot's clock [s] */
    double age_s;           /* how old it is when it comes: --fault delay and jitter [s] */
    uint32_t sequence;      /* from 1, over all episodes; answers repeat it */
    uint32_t episode;       /* from 0; from 0 again with each --fault. Reset what has a memory when an episode begins: */
    uint32_t step;          /* where `episode` changes or `step` decreases. Step 0 itself may be lost (--fault drop). */
    uint16_t measured_size; /* number of values of a measurement or an observation */
    uint16_t command_size;  /* number of values of a command */
    float values[RLCTL_ROBOT_MAX_VALUES];
} rlctl_robot_packet;
#pragma pack(pop)

#endif
