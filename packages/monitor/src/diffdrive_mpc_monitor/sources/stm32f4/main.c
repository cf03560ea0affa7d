/* Judge in a loop over USART1 (PA9, PA10; 115200 baud at the 16 MHz clock after reset). It sends one double when it is
 * ready, and then replies to each message of eight doubles with eight doubles.
 *
 * In: kind of the message (numbers below), now, stamp, up to five values. Out: 1 if a command is to be sent, v, omega,
 * rule, time of the verdict, value, limit, and duration of the call [ticks of SysTick].
 */
#include "board.h"
#include "judge.h"
#include "rules.h"

enum { START, POINT, REFERENCE, ODOMETRY, GYRO, POSE, SAYS, COMMAND, TICK, RESET };
enum { MAX_POINTS = 1000 };

static ddmon_judge judge;
/* Two buffers, because the judge uses the old path until it has the new one. */
static ddmon_point path[2][MAX_POINTS];
static int points, buffer;

static void add_point(const double *value)
{
    if (points < MAX_POINTS) {
        const ddmon_point point = {value[0], value[1], value[2], value[3]};
        path[buffer][points] = point;
        points++;
    }
}

static void handle_message(const double in[8], double out[8])
{
    const double now = in[1], stamp = in[2], *value = in + 3;
    ddmon_verdict verdict;
    switch ((int)in[0]) {
    case START:
        ddmon_init(&judge, &ddmon_default_rules, now);
        points = 0;
        break;
    case POINT:
        add_point(value);
        break;
    case REFERENCE:
        out[0] = ddmon_reference(&judge, now, path[buffer], points);
        buffer = !buffer;
        points = 0;
        break;
    case ODOMETRY:
        ddmon_odometry(&judge, now, stamp, value[0], value[1], value[2], value[3], value[4]);
        break;
    case GYRO:
        ddmon_gyro(&judge, now, stamp, value[0]);
        break;
    case POSE:
        ddmon_pose(&judge, now, stamp, value[0], value[1], value[2]);
        break;
    case SAYS:
        ddmon_says(&judge, now, value[0] != 0.0);
        break;
    case COMMAND:
        ddmon_command(&judge, now, stamp, value[0], value[1], out + 1);
        out[0] = 1.0;
        break;
    case TICK:
        out[0] = ddmon_tick(&judge, now, out + 1);
        break;
    case RESET:
        verdict = ddmon_reset(&judge, now);
        out[0] = verdict.rule;
        break;
    default:
        break;
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
        handle_message(in, out);
        out[7] = passed(since);
        out[3] = judge.verdict.rule;
        out[4] = judge.verdict.at;
        out[5] = judge.verdict.value;
        out[6] = judge.verdict.limit;
        transmit(out, sizeof out);
    }
}
