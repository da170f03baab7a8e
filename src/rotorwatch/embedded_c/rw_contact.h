/* Knocks: forces and torques on the vehicle that its rotors cannot make. Tick by tick, on the ground as well.

   Rotors push along the body's axis and turn it with what they push. A sideways force that begins within a tick, a lift that nobody
   commanded, or an angular acceleration beyond what the commands and the loss of any two rotors explain comes from outside. */
#ifndef RW_CONTACT_H
#define RW_CONTACT_H

#include "rw_types.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Ticks in the half second before one, which it is held against: of rw_config.h. */
#ifndef RW_TICKS_BEFORE
#error "RW_TICKS_BEFORE must be 0.5 s in ticks, rounded, at least 2"
#endif

/* How much the accelerometer shakes, from the first sample of a flight log, or since switched on, up to now. */
typedef struct {
    double total; /* (m/s^2)^2: a sum over the whole flight, single precision would stop growing */
    uint32_t count;
} rw_vibration;

void rw_vibration_init(rw_vibration *s);

/* One more sample of specific force [3], m/s^2. sum [3], count: of the samples in the half second before it, without itself. */
void rw_vibration_sample(rw_vibration *s, const rw_real *force, const rw_real *sum, int count);

/* Root mean square so far, m/s^2; what knocks add is cut off. */
rw_real rw_vibration_rms(const rw_vibration *s);

/* What a tick is judged by. */
typedef struct {
    rw_time time;                /* s */
    rw_real thrust[RW_ROTORS];   /* commanded, hover thrusts */
    rw_real torque[3];           /* commanded roll, pitch and yaw, hover thrusts: effectiveness times thrust */
    rw_real rate_dot[3];         /* angular acceleration, rad/s^2 */
    rw_real side[2];             /* specific force forward and right, mean of this tick alone, m/s^2 */
    rw_real load;                /* specific force up over g */
    rw_real shake;               /* rw_vibration_rms at the beginning of the tick, m/s^2 */
    bool fresh;                  /* in the air, and all of these are known */
    bool accelerometer;          /* side, load and shake are known at all */
} rw_shove;

/* What was found in it. */
typedef struct {
    rw_time time;  /* s, of the contact that the tick belongs to: its first tick */
    rw_real size;  /* g, or hover thrusts of one rotor where it turned the vehicle; of its largest tick so far */
    bool hit;      /* something outside pushed the vehicle in this tick */
    bool news;     /* a new contact, or one that was larger than thought */
    uint8_t push;  /* enum rw_push */
} rw_touch;

typedef struct {
    rw_time hit;                       /* s, of the last tick with a knock; -RW_LASTS before */
    rw_touch last;                     /* the last contact */
    rw_real before[RW_TICKS_BEFORE][4]; /* ring: side force, load, load less mean thrust; 0 where not fresh */
    bool fresh[RW_TICKS_BEFORE];
    rw_real turning;                   /* rad/s^2, of the tick before */
    int16_t next;                      /* place in the ring */
} rw_contact;

void rw_contact_init(rw_contact *s);

/* One more tick, of all in their order. */
rw_touch rw_contact_tick(rw_contact *s, const rw_shove *tick);

#ifdef __cplusplus
}
#endif

#endif
