/* robot_client [PORT [HOST]]: runs controller.c (`rlctl export --controller`) against `rlctl robot --controller`, by UDP.
 *
 * The loop of a robot: measurements in, controller_step, targets out. With a key: RLCTL_API_KEY in the environment.
 */
#define _POSIX_C_SOURCE 200112L

#include <netdb.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>

#include "controller.h"
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
    rlctl_robot_packet hello = {RLCTL_ROBOT_MAGIC, RLCTL_ROBOT_VERSION, RLCTL_ROBOT_HELLO, 0, 0, 0, 0, 0, 0, 0, 0, {0}};
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

/* The measurement as the controller takes it, and its targets; where the task has none, its actions. */
static int control(controller_state *state, const rlctl_robot_packet *packet, float *command)
{
    controller_inputs inputs;
    controller_outputs outputs;
    CONTROLLER_NUMBER *numbers = (CONTROLLER_NUMBER *)&inputs; /* its members, one after the other */
    for (int i = 0; i < CONTROLLER_INPUT_SIZE; ++i) {
        numbers[i] = packet->values[i];
    }
    const int may_send = controller_step(state, &inputs, packet->age_s, &outputs);
    for (int i = 0; i < CONTROLLER_ACTION_SIZE; ++i) {
#ifdef CONTROLLER_TARGET
        command[i] = (float)outputs.target[i];
#else
        command[i] = (float)outputs.action[i];
#endif
    }
    return may_send;
}

/* Returns 0 and prints a line for a robot that does not fit the controller. */
static int fits(const rlctl_robot_packet *packet)
{
    if (packet->kind != RLCTL_ROBOT_MEASUREMENT) {
        fprintf(stderr, "robot_client: the robot sends observations: start it with --controller\n");
        return 0;
    }
    if (packet->measured_size != CONTROLLER_INPUT_SIZE || packet->command_size != CONTROLLER_ACTION_SIZE) {
        fprintf(stderr, "robot_client: the robot sends %d numbers and takes %d, the controller has %d and %d\n",
                packet->measured_size, packet->command_size, CONTROLLER_INPUT_SIZE, CONTROLLER_ACTION_SIZE);
        return 0;
    }
    return 1;
}

int main(int count, char **arguments)
{
    const int robot = connect_to_robot(count > 2 ? arguments[2] : "127.0.0.1", count > 1 ? arguments[1] : "8001");
    if (robot < 0) {
        perror("robot_client");
        return 1;
    }
    controller_state state;
    rlctl_robot_packet packet;
    uint32_t last = 0, episode = 0, step = 0; /* of the measurement that was answered last */
    float command[CONTROLLER_ACTION_SIZE];
    int may_send = 0;
    controller_init(&state);
    say_hello(robot);
    for (;;) {
        if (!receive(robot, &packet, last == 0)) {
            fprintf(stderr, "robot_client: the robot sends nothing\n");
            return 1;
        }
        if (packet.kind == RLCTL_ROBOT_END) {
            break;
        }
        if (!fits(&packet)) {
            return 1;
        }
        if (packet.sequence != last) { /* else the robot has not received the answer: it gets the same again */
            if (packet.episode != episode || packet.step < step) {
                controller_resume(&state); /* a new episode ends a stop: on a robot of your own, a person does that */
                controller_reset(&state);
            }
            may_send = control(&state, &packet, command);
            last = packet.sequence;
            episode = packet.episode;
            step = packet.step;
        }
        packet.kind = may_send ? RLCTL_ROBOT_COMMAND : RLCTL_ROBOT_NO_COMMAND;
        memcpy(packet.values, command, sizeof command);
        if (send(robot, &packet, RLCTL_ROBOT_HEADER_SIZE + (may_send ? sizeof command : 0), 0) < 0) {
            perror("robot_client");
        }
    }
    close(robot);
    printf("%u measurements answered\n", (unsigned)last);
    return 0;
}
