/* The UDP protocol of `rlctl robot`: one packed struct, little-endian, in both directions.
 *
 *   program -> robot   HELLO, repeated until an observation comes; after the header the key, if the robot needs one
 *   robot -> program   OBSERVATION; sent again after 0.25 s if no command has come, with the same sequence: a program
 *                      with a memory then repeats its command and does not act again
 *   program -> robot   COMMAND: the header of the observation with this kind, and the action
 *   robot -> program   END: the test is over
 *
 * A packet has the header and as many values as its kind has; the values after them are not sent. The order, names and
 * units of observation and action are those of the task, as in the header of `rlctl export --c`.
 */
#ifndef RLCTL_ROBOT_H
#define RLCTL_ROBOT_H

#include <stdint.h>

#define RLCTL_ROBOT_MAGIC 0x52434c52u /* the bytes "RLCR" */
#define RLCTL_ROBOT_VERSION 1
#define RLCTL_ROBOT_MAX_VALUES 1024
#define RLCTL_ROBOT_HEADER_SIZE 32 /* [bytes] */

enum { RLCTL_ROBOT_HELLO = 1, RLCTL_ROBOT_OBSERVATION = 2, RLCTL_ROBOT_COMMAND = 3, RLCTL_ROBOT_END = 4 };

#pragma pack(push, 1)
typedef struct {
    uint32_t magic;
    uint16_t version;
    uint16_t kind;
    uint64_t session;          /* drawn by the robot; commands repeat it */
    uint32_t sequence;         /* of the observation, from 1, over all episodes; commands repeat it */
    uint32_t episode;          /* from 0 */
    uint32_t step;             /* of the episode, from 0: there a policy with a memory is reset */
    uint16_t observation_size; /* number of values of an observation */
    uint16_t action_size;      /* number of values of an action */
    float values[RLCTL_ROBOT_MAX_VALUES];
} rlctl_robot_packet;
#pragma pack(pop)

#endif
