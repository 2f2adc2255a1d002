/* What the app uses of the Crazyflie's firmware, for a rehearsal without it: the same names and types, see
   rehearsal.c. The headers beside this one stand for those of the firmware. */
#ifndef FIRMWARE_H
#define FIRMWARE_H

#include <stddef.h>
#include <stdint.h>

#define M2T(milliseconds) ((uint32_t)(milliseconds))

typedef enum { modeDisable = 0, modeAbs, modeVelocity } mode_t_;
typedef struct {
    float x, y, z;
} place_t;
typedef struct {
    place_t position, velocity;
    struct {
        mode_t_ x, y, z, yaw;
    } mode;
} setpoint_t;
typedef uint16_t logVarId_t;

void appMain(void);
uint32_t xTaskGetTickCount(void);
void vTaskDelayUntil(uint32_t *woken, uint32_t ticks);
size_t appchannelReceivePacket(void *buffer, size_t most, int timeout);
void commanderSetSetpoint(setpoint_t *setpoint, int priority);
logVarId_t logGetVarId(const char *group, const char *name);
float logGetFloat(logVarId_t which);

#endif
