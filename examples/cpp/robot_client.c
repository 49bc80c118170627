/* robot_client [PORT [HOST]]: runs the policy of policy.c (`rlctl export --c`) against `rlctl robot`, by UDP.
 *
 * Replace policy_act by your own program. With a key: RLCTL_API_KEY in the environment.
 */
#define _POSIX_C_SOURCE 200112L

#include <math.h>
#include <netdb.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>

#include "policy.h"
#include "rlctl_robot.h"

enum { PATIENCE = 300 }; /* tenths of a second without a packet until the robot is given up */

typedef char header_has_its_size[sizeof(rlctl_robot_packet) == RLCTL_ROBOT_HEADER_SIZE + 4 * RLCTL_ROBOT_MAX_VALUES ? 1 : -1];

static int connect_to_robot(const char *host, const char *port)
{
    struct addrinfo hints = {0}, *found = NULL;
    hints.ai_socktype = SOCK_DGRAM;
    if (getaddrinfo(host, port, &hints, &found) != 0) {
        return -1;
    }
    const int robot = socket(found->ai_family, SOCK_DGRAM, 0);
    const struct timeval tenth = {0, 100000};
    if (robot < 0 || connect(robot, found->ai_addr, found->ai_addrlen) != 0 ||
        setsockopt(robot, SOL_SOCKET, SO_RCVTIMEO, &tenth, sizeof tenth) != 0) {
        return -1;
    }
    freeaddrinfo(found);
    return robot;
}

static void say_hello(int robot)
{
    rlctl_robot_packet hello = {RLCTL_ROBOT_MAGIC, RLCTL_ROBOT_VERSION, RLCTL_ROBOT_HELLO, 0, 0, 0, 0, 0, 0, {0}};
    const char *key = getenv("RLCTL_API_KEY");
    size_t length = key == NULL ? 0 : strlen(key);
    if (length > sizeof hello.values) {
        length = 0;
    }
    if (length > 0) {
        memcpy(hello.values, key, length);
    }
    (void)send(robot, &hello, RLCTL_ROBOT_HEADER_SIZE + length, 0); /* a failure is like a lost packet: it is repeated */
}

/* Waits for the next packet of the robot; returns 0 if none has come in time. */
static int receive(int robot, rlctl_robot_packet *packet, int greeting)
{
    for (int waited = 0; waited < PATIENCE; ++waited) {
        const ssize_t size = recv(robot, packet, sizeof *packet, 0);
        if (size >= RLCTL_ROBOT_HEADER_SIZE && packet->magic == RLCTL_ROBOT_MAGIC &&
            packet->version == RLCTL_ROBOT_VERSION) {
            return 1;
        }
        if (greeting) {
            if (size < 0) { /* nobody listens yet, which comes back at once, or no answer within a tenth of a second */
                const struct timeval tenth = {0, 100000};
                struct timeval rest = tenth;
                (void)select(0, NULL, NULL, NULL, &rest);
            }
            say_hello(robot);
        }
    }
    return 0;
}

int main(int count, char **arguments)
{
    const int robot = connect_to_robot(count > 2 ? arguments[2] : "127.0.0.1", count > 1 ? arguments[1] : "8001");
    if (robot < 0) {
        perror("robot_client");
        return 1;
    }
    rlctl_robot_packet packet;
    uint32_t last = 0;                              /* sequence of the observation that was answered last */
    float observation[POLICY_OBSERVATION_SIZE], action[POLICY_ACTION_SIZE] = {0};
    say_hello(robot);
    for (;;) {
        if (!receive(robot, &packet, last == 0)) {
            fprintf(stderr, "robot_client: the robot sends nothing\n");
            return 1;
        }
        if (packet.kind == RLCTL_ROBOT_END) {
            break;
        }
        if (packet.kind != RLCTL_ROBOT_OBSERVATION) {
            continue;
        }
        if (packet.observation_size != POLICY_OBSERVATION_SIZE || packet.action_size != POLICY_ACTION_SIZE) {
            fprintf(stderr, "robot_client: the robot has %d observations and %d actions, the policy %d and %d\n",
                    packet.observation_size, packet.action_size, POLICY_OBSERVATION_SIZE, POLICY_ACTION_SIZE);
            return 1;
        }
        if (packet.sequence != last) { /* else the robot has not received the answer: it gets the same again */
            int is_finite = 1;
            memcpy(observation, packet.values, sizeof observation);
            for (int i = 0; i < POLICY_OBSERVATION_SIZE; ++i) {
                is_finite = is_finite && isfinite(observation[i]);
            }
            if (is_finite) { /* else the last action is held; a robot of your own may need another answer */
                policy_act(observation, action);
            }
            last = packet.sequence;
        }
        packet.kind = RLCTL_ROBOT_COMMAND;
        memcpy(packet.values, action, sizeof action);
        if (send(robot, &packet, RLCTL_ROBOT_HEADER_SIZE + sizeof action, 0) < 0) {
            perror("robot_client");
        }
    }
    close(robot);
    printf("%u observations answered\n", (unsigned)last);
    return 0;
}
