/* The exported controller: call ddmpc_init once, ddmpc_start with a reference, then ddmpc_step at every tick.
 *
 * SI units, frames as in REP 103: x forward, y left, yaw counter-clockwise. No allocation. OSQP's work space is global:
 * one controller to a program, and one thread to a controller.
 */
#ifndef DDMPC_H
#define DDMPC_H

#include "condense.h"
#include "estimator.h"
#include "trajectory_table.h"
#include "solver.h"
#include "tick_clock.h"

typedef enum {
    DDMPC_TRACKING,    /* the command is the first of a fresh plan */
    DDMPC_REUSED_PLAN, /* the solve failed; the command comes from the rest of the last good plan */
    DDMPC_BRAKING,     /* the command ramps to zero at the slew limit */
    DDMPC_STOPPED,     /* the command is zero */
    DDMPC_FINISHED     /* the end of the reference is reached; the command ramps to zero and stays there */
} ddmpc_mode;

/* Why the mode is not plain TRACKING, or what is odd about this tick; several may hold at once. */
enum {
    DDMPC_NO_REFERENCE = 1 << 0,    /* ddmpc_start was not called */
    DDMPC_NO_POSE = 1 << 1,         /* none has arrived yet */
    DDMPC_ELSEWHERE = 1 << 2,       /* poses agree that the robot is somewhere else */
    DDMPC_LOST = 1 << 3,            /* the estimate is not finite; it starts anew */
    DDMPC_OLD_POSE = 1 << 4,        /* no pose was accepted for longer than failure.max_pose_age */
    DDMPC_LATCHED = 1 << 5,         /* stopped after a failure; call start or reset to drive on */
    DDMPC_TOO_FAR = 1 << 6,         /* from the reference: failure.max_position_error */
    DDMPC_SOLVE_FAILED = 1 << 7,    /* the report says why */
    DDMPC_NOT_AT_REST = 1 << 8,     /* finished by finish.timeout */
    DDMPC_SENT_REJECTED = 1 << 9,   /* it is not a command that a robot can have got */
    DDMPC_MEASUREMENT_REJECTED = 1 << 10, /* the notes say which and why */
    DDMPC_HELD = 1 << 11,           /* the application asked it to stand */
    DDMPC_TIME_FAULTY = 1 << 12,    /* not finite, or running backwards */
    DDMPC_TIME_REPEATED = 1 << 13,  /* too soon after the last tick; its command is repeated */
    DDMPC_TIME_LEAPT = 1 << 14,     /* no tick for too long: a pause, or a glitch of the clock */
    DDMPC_TIME_PAUSED = 1 << 15     /* so long that the estimate starts anew */
};

/* What the application asks beside the reference. A pause is no failure; after one, failure.resume decides. */
typedef enum { DDMPC_DRIVE, DDMPC_PAUSE, DDMPC_STOP_AS_FAILURE } ddmpc_request;

/* What one tick begins with. Leave `present` and `has_sent` zero where nothing is new. */
typedef struct {
    ddmpc_measurement measurement;
    real sent[2]; /* what the robot really got last tick [m/s, rad/s] */
    int has_sent;
    ddmpc_request request;
} ddmpc_input;

typedef struct {
    real command[2]; /* v_ref [m/s], omega_ref [rad/s]; finite and inside range and slew */
    ddmpc_mode mode;
    unsigned int reasons;
    ddmpc_report solver;
    ddmpc_notes notes;       /* measurements that were rejected */
    ddmpc_estimate estimate; /* only with has_estimate */
    int has_estimate;
} ddmpc_result;

typedef struct {
    ddmpc_estimator estimator;
    ddmpc_solver solver;
    ddmpc_clock clock;
    ddmpc_reference reference;
    ddmpc_time t0;
    real last[2];                /* the command that slew counts from */
    real plan[DDMPC_INPUTS];   /* the last good one */
    int plan_age;                /* ticks since it was made; -1: there is none */
    real guess[DDMPC_INPUTS];  /* the last plan, a step ahead */
    int has_guess, has_reference, has_result, has_driven, latched, finished;
    ddmpc_situation situation;
    ddmpc_tick tick;
    ddmpc_qp qp;
    ddmpc_workspace work;
    ddmpc_result result;
} ddmpc_controller;

/* Be as new, for a robot that stands still; forgets the reference, too. */
void ddmpc_init(ddmpc_controller *controller);

/* Track `reference` from now on; its time 0 is `t0` [s] on the clock of ddmpc_step. The robot may be moving. Looks at
   the whole reference once, sample by sample.

   Returns 0, and changes nothing, if `t0` is not finite or the reference is faster than the limits. */
int ddmpc_start(ddmpc_controller *controller, const ddmpc_reference *reference, ddmpc_time t0);

/* Forget estimate, plan and commands, for a robot that stands still. The reference stays. */
void ddmpc_reset(ddmpc_controller *controller);

/* Decide the command for the tick at `t` [s] from what arrived since the last one. */
void ddmpc_step(ddmpc_controller *controller, ddmpc_time t, const ddmpc_input *input, ddmpc_result *result);

#endif
