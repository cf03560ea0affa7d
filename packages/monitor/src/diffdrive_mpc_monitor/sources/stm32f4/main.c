/* The judge in the loop over USART1 (PA9, PA10; 115200 baud at the 16 MHz after reset): eight doubles in, eight out, after one
 * that says that it listens.
 *
 * In: what (the numbers below), now, stamp, and up to five values. Out: whether there is something to send, v, omega,
 * rule, when, value, limit, and how many ticks of SysTick the judge took.
 */
#include "board.h"
#include "judge.h"
#include "rules.h"

enum { BEGIN, POINT, REFERENCE, ODOMETRY, GYRO, POSE, SAYS, COMMAND, TICK, RESET };
enum { MOST_POINTS = 1000 };

static ddmon_judge judge;
/* Two: the judge looks at the old one until it has the new one. */
static ddmon_point path[2][MOST_POINTS];
static int points, side;

static void take_point(const double *value)
{
    if (points < MOST_POINTS) {
        const ddmon_point point = {value[0], value[1], value[2], value[3]};
        path[side][points] = point;
        points++;
    }
}

static void take(const double in[8], double out[8])
{
    const double now = in[1], stamp = in[2], *value = in + 3;
    ddmon_verdict wrong;
    switch ((int)in[0]) {
    case BEGIN: ddmon_init(&judge, &ddmon_default_rules, now); points = 0; break;
    case POINT: take_point(value); break;
    case REFERENCE: out[0] = ddmon_reference(&judge, now, path[side], points); side = !side; points = 0; break;
    case ODOMETRY: ddmon_odometry(&judge, now, stamp, value[0], value[1], value[2], value[3], value[4]); break;
    case GYRO: ddmon_gyro(&judge, now, stamp, value[0]); break;
    case POSE: ddmon_pose(&judge, now, stamp, value[0], value[1], value[2]); break;
    case SAYS: ddmon_says(&judge, now, value[0] != 0.0); break;
    case COMMAND: ddmon_command(&judge, now, stamp, value[0], value[1], out + 1); out[0] = 1.0; break;
    case TICK: out[0] = ddmon_tick(&judge, now, out + 1); break;
    case RESET: wrong = ddmon_reset(&judge, now); out[0] = wrong.rule; break;
    default: break;
    }
}

int main(void)
{
    const double ready = 1.0;
    set_up();
    ddmon_init(&judge, &ddmon_default_rules, 0.0);
    transmit(&ready, sizeof ready);
    for (;;) {
        double in[8], out[8] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
        receive(in, sizeof in);
        uint32_t since = SYSTICK_VALUE;
        take(in, out);
        out[7] = passed(since);
        out[3] = judge.verdict.rule;
        out[4] = judge.verdict.at;
        out[5] = judge.verdict.value;
        out[6] = judge.verdict.limit;
        transmit(out, sizeof out);
    }
}
