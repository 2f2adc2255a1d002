/* The evader as an app of the Crazyflie's firmware: it flies at a target at one height, past the shield.

   sidestep.h and sidestep.c beside this file are an export (see README.md). Poses of the other robots and the
   target come over the app channel, from a computer that sees them; its own position from the estimator. */

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#include "FreeRTOS.h"
#include "task.h"

#include "app.h"
#include "app_channel.h"
#include "commander.h"
#include "log.h"

#include "sidestep.h"

#define SPEED 0.1574f /* evader_speed of the scenario, m/s */
#define HEIGHT 0.5f   /* m */
#define STALE 0.2f    /* age in s from which a pose is not one any more */
#define PRIORITY 3    /* of set points: above those of the radio */
#define PURSUERS (sizeof((sidestep_world *)0)->pursuers / sizeof((sidestep_world *)0)->pursuers[0])
#define OBSTACLES (sizeof((sidestep_world *)0)->obstacles / sizeof((sidestep_world *)0)->obstacles[0])

/* A packet: 'p' x, y, heading of pursuer `index`; 'o' x, y, vx, vy of obstacle `index`; 't' x, y of the target,
   which also begins the flight; 'l' lands. World axes; m, rad, m/s. */
typedef struct __attribute__((packed)) {
    char kind;
    uint8_t index;
    float value[4];
} packet_t;

static sidestep_world world;
static uint32_t seen_pursuer[PURSUERS], seen_obstacle[OBSTACLES];
static float target[2];
static bool flying;

static void receive(uint32_t now)
{
    packet_t packet;
    size_t length;
    while ((length = appchannelReceivePacket(&packet, sizeof packet, 0)) > 0) {
        if (length < sizeof packet) {
            continue;
        }
        if (packet.kind == 'p' && packet.index < PURSUERS) {
            memcpy(world.pursuers[packet.index], packet.value, sizeof world.pursuers[0]);
            seen_pursuer[packet.index] = now;
        } else if (packet.kind == 'o' && packet.index < OBSTACLES) {
            memcpy(world.obstacles[packet.index], packet.value, sizeof world.obstacles[0]);
            seen_obstacle[packet.index] = now;
        } else if (packet.kind == 't') {
            memcpy(target, packet.value, sizeof target);
            flying = true;
        } else if (packet.kind == 'l') {
            flying = false;
        }
    }
}

/* A pose that is too old is not known: the shield then answers 3 and comes as near to a stop as the rest
   allows. */
static void forget(uint32_t now)
{
    for (size_t k = 0; k < PURSUERS; k++) {
        if (now - seen_pursuer[k] > M2T(1000.0f * STALE)) {
            world.pursuers[k][0] = NAN;
        }
    }
    for (size_t k = 0; k < OBSTACLES; k++) {
        if (now - seen_obstacle[k] > M2T(1000.0f * STALE)) {
            world.obstacles[k][0] = NAN;
        }
    }
}

static void fly(const float velocity[2])
{
    setpoint_t setpoint;
    memset(&setpoint, 0, sizeof setpoint);
    setpoint.mode.x = modeVelocity;
    setpoint.mode.y = modeVelocity;
    setpoint.mode.z = modeAbs;
    setpoint.mode.yaw = modeVelocity; /* does not turn */
    setpoint.velocity.x = velocity[0];
    setpoint.velocity.y = velocity[1];
    setpoint.position.z = HEIGHT;
    commanderSetSetpoint(&setpoint, PRIORITY);
}

void appMain(void)
{
    const logVarId_t x = logGetVarId("stateEstimate", "x"), y = logGetVarId("stateEstimate", "y");
    sidestep_memory memory;
    sidestep_answer answer;
    bool begun = false;
    uint32_t woken = xTaskGetTickCount();
    for (;;) {
        vTaskDelayUntil(&woken, M2T(1000.0f * SIDESTEP_PERIOD));
        receive(woken);
        if (!flying) {
            /* Without set points the commander lands, and switches off after two seconds. */
            begun = false;
            continue;
        }
        world.evader[0] = logGetFloat(x);
        world.evader[1] = logGetFloat(y);
        forget(woken);
        if (!begun) {
            sidestep_start(&world, &memory);
            begun = true;
        }
        float wish[2] = {target[0] - world.evader[0], target[1] - world.evader[1]};
        const float distance = sqrtf(wish[0] * wish[0] + wish[1] * wish[1]);
        const float pace = fminf(SPEED, distance / SIDESTEP_PERIOD) / fmaxf(distance, 1e-6f);
        wish[0] *= pace;
        wish[1] *= pace;
        sidestep_filter(&world, wish, &memory, &answer);
        fly(answer.velocity);
    }
}
