/* Monitored robot on a straight line; its controller fails after two seconds. */
#include <stdio.h>

#include "judge.h"
#include "rules.h"

#define SAMPLE 0.02
#define SPEED 0.4

int main(void)
{
    static ddmon_judge judge; /* static, because it needs some kilobytes */
    static ddmon_point line[101];
    double now = 1000.0, v = 0.0, omega = 0.0, x = 0.0, y = 0.0, theta = 0.0, out[2] = {0.0, 0.0};
    int reported = 0;
    for (int k = 0; k <= 100; k++) {
        const ddmon_point point = {now + 0.1 * k, 0.1 * SPEED * k, 0.0, 0.0};
        line[k] = point;
    }
    ddmon_init(&judge, &ddmon_default_rules, now);
    if (!ddmon_reference(&judge, now, line, 101))
        return 2;
    for (int tick = 0; tick < 400; tick++, now += SAMPLE) {
        double command[2] = {SPEED < 2.0 * SAMPLE * tick ? SPEED : 2.0 * SAMPLE * tick, tick < 100 ? 0.0
                                                                                        : tick < 105
                                                                                            ? 0.1 * (tick - 100)
                                                                                            : 0.5};
        ddmon_gyro(&judge, now, now, omega);
        ddmon_odometry(&judge, now, now, v, omega, x, y, theta);
        ddmon_pose(&judge, now, now, x, y, theta);
        ddmon_command(&judge, now, now, command[0], command[1], out);
        ddmon_tick(&judge, now, out);
        if (judge.verdict.rule != DDMON_NOTHING && !reported) {
            reported = 1;
            printf("%.2f s: %s: %.3f %s, the limit is %.3f %s\n", judge.verdict.at - 1000.0,
                   ddmon_words(judge.verdict.rule), judge.verdict.value, ddmon_unit(judge.verdict.rule),
                   judge.verdict.limit, ddmon_unit(judge.verdict.rule));
        }
        /* Robot with a first-order lag of 0.1 s, in small-angle approximation. */
        v += 0.2 * (out[0] - v);
        omega += 0.2 * (out[1] - omega);
        x += SAMPLE * v * (1.0 - 0.5 * theta * theta);
        y += SAMPLE * v * theta;
        theta += SAMPLE * omega;
    }
    printf("final position: %.2f m, %.2f m\n", x, y);
    return !reported;
}
