/* The app on a PC: a differential drive chases it, an obstacle drifts. Prints how near they came, and how long it
   took to the target; 1 where it was captured, collided or did not arrive. With an argument, no pose arrives for
   half a second on the way. */

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "firmware.h"

/* The paper's speeds and distances, m/s and m. */
#define PURSUER_SPEED 0.2f
#define HALF_AXLE 0.2f
#define CAPTURE 0.2f
#define COLLISION 0.2f
#define LIMIT 60000U
#define SILENT_FROM 6000U
#define SILENT_TO 6500U

static uint32_t now;
static float evader[2], velocity[2], pursuer[3] = {1.5f, 0.6f, 3.0f}, obstacle[4] = {1.3f, -0.15f, 0.0f, 0.02f};
static const float target[2] = {2.5f, 0.0f};
static float nearest_pursuer = INFINITY, nearest_obstacle = INFINITY, fastest_unseen;
static int sent, blind;

static void advance(float seconds)
{
    evader[0] += seconds * velocity[0];
    evader[1] += seconds * velocity[1];
    obstacle[0] += seconds * obstacle[2];
    obstacle[1] += seconds * obstacle[3];
    /* Turns on the spot until it faces the evader, then drives. */
    float off = atan2f(evader[1] - pursuer[1], evader[0] - pursuer[0]) - pursuer[2];
    off = atan2f(sinf(off), cosf(off));
    const float most = seconds * PURSUER_SPEED / HALF_AXLE;
    const float turn = fmaxf(-most, fminf(most, off));
    pursuer[2] += turn;
    const float drive = seconds * PURSUER_SPEED * (1.0f - fabsf(turn) / most);
    pursuer[0] += drive * cosf(pursuer[2]);
    pursuer[1] += drive * sinf(pursuer[2]);
    nearest_pursuer = fminf(nearest_pursuer, hypotf(pursuer[0] - evader[0], pursuer[1] - evader[1]));
    nearest_obstacle = fminf(nearest_obstacle, hypotf(obstacle[0] - evader[0], obstacle[1] - evader[1]));
}

static void end(void)
{
    const int arrived = hypotf(target[0] - evader[0], target[1] - evader[1]) < 0.1f;
    printf("%s after %.1f s; pursuer at least %.3f m away, obstacle %.3f m; at most %.4f m/s while unseen\n",
           arrived ? "arrived" : "did not arrive", 1e-3 * now, nearest_pursuer, nearest_obstacle, fastest_unseen);
    exit(!arrived || nearest_pursuer < CAPTURE || nearest_obstacle < COLLISION);
}

uint32_t xTaskGetTickCount(void) { return now; }

void vTaskDelayUntil(uint32_t *woken, uint32_t ticks)
{
    for (uint32_t k = 0; k < ticks; k++) {
        advance(1e-3f);
    }
    now += ticks;
    *woken = now;
    sent = 0;
    if (blind && now > SILENT_FROM + 250U && now <= SILENT_TO) {
        fastest_unseen = fmaxf(fastest_unseen, hypotf(velocity[0], velocity[1]));
    }
    if (now > LIMIT || hypotf(target[0] - evader[0], target[1] - evader[1]) < 0.1f) {
        end();
    }
}

size_t appchannelReceivePacket(void *buffer, size_t most, int timeout)
{
    (void)timeout;
    struct __attribute__((packed)) {
        char kind;
        uint8_t index;
        float value[4];
    } packet = {0};
    const char kinds[] = "pot";
    if (sent == 3 || (blind && now > SILENT_FROM && now <= SILENT_TO)) {
        return 0;
    }
    packet.kind = kinds[sent++];
    if (packet.kind == 'p') {
        memcpy(packet.value, pursuer, sizeof pursuer);
    } else if (packet.kind == 'o') {
        memcpy(packet.value, obstacle, sizeof obstacle);
    } else {
        memcpy(packet.value, target, sizeof target);
    }
    memcpy(buffer, &packet, most < sizeof packet ? most : sizeof packet);
    return sizeof packet;
}

void commanderSetSetpoint(setpoint_t *setpoint, int priority)
{
    (void)priority;
    velocity[0] = setpoint->velocity.x;
    velocity[1] = setpoint->velocity.y;
}

logVarId_t logGetVarId(const char *group, const char *name)
{
    (void)group;
    return name[0] == 'x' ? 0 : 1;
}

float logGetFloat(logVarId_t which) { return evader[which]; }

int main(int count, char **arguments)
{
    (void)arguments;
    blind = count > 1;
    appMain();
    return 0;
}
