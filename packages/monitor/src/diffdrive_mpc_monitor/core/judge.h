/* Judge of the monitor: checks the commands of a controller and the motion of the robot, and passes or replaces commands.
 * Plain C99 without allocation and input or output; it uses no code of the controller.
 *
 * Times are in s on one monotonic clock, lengths in m, angles in rad, counter-clockwise. Call from one thread.
 */
#ifndef DDMON_JUDGE_H
#define DDMON_JUDGE_H

#ifndef DDMON_EXPORT
#define DDMON_EXPORT
#endif

/* Limits of the rules, which docs/safety.md describes. A rule that is violated for longer than its limit stops the
   robot. */
typedef struct {
    double commands_v;           /* maximum |v| [m/s] */
    double commands_omega;       /* maximum |omega| [rad/s] */
    double commands_v_reverse;   /* maximum speed in reverse [m/s]; 0: as v */
    double commands_omega_right; /* maximum yaw rate to the right [rad/s]; 0: as omega */
    double commands_v_slew;      /* maximum rate of change of v away from zero [m/s^2] */
    double commands_omega_slew;  /* maximum rate of change of omega away from zero [rad/s^2] */
    double
        commands_v_braking; /* maximum rate of change of v towards zero; also the braking rate of the monitor [m/s^2] */
    double
        commands_omega_braking; /* maximum rate of change of omega towards zero; also the braking rate of the monitor [rad/s^2] */
    double commands_jitter;         /* tolerated error in the timing of commands, for the slew check [s] */
    double commands_silence;        /* maximum time without a command while the last command moves the robot [s] */
    double commands_slowest;        /* maximum mean interval between commands while the robot moves [s] */
    double commands_quickest;       /* minimum mean interval between commands [s] */
    double commands_oldest;         /* maximum age of a command that moves the robot, by its stamp [s] */
    double commands_stop_within;    /* time for commands to become zero after the controller reports standstill [s] */
    double commands_standing_v;     /* maximum speed of a command or motion that counts as standstill [m/s] */
    double commands_standing_omega; /* maximum yaw rate of a command or motion that counts as standstill [rad/s] */
    double
        commands_rest_distance; /* maximum distance that the robot moves after the controller reports standstill [m] */
    double commands_rest_turn;  /* maximum angle by which the robot turns after that report [rad] */
    double path_distance;       /* maximum distance from the path section around the reference [m] */
    double path_lasting;        /* maximum time for which the distance may be exceeded [s] */
    double path_far;            /* maximum distance of the pose at rest after braking now [m] */
    double path_reaction;       /* delay until braking begins [s] */
    double path_heading;        /* maximum angle to the headings of the path section [rad] */
    double path_far_lasting;    /* maximum time for which `far` or `heading` may be exceeded [s] */
    double path_late;           /* start of the path section, as a time before the present reference [s] */
    double path_early;          /* end of the path section, as a time after the present reference [s] */
    double path_grace; /* maximum time of motion without a reference, or while the controller reports standstill [s] */
    double returning_within;   /* maximum time away from the path section while returning [s] */
    double returning_distance; /* maximum distance of the pose at rest after braking now, while returning [m] */
    double returning_late;  /* start of the path section while returning, as a time before the present reference [s] */
    double returning_early; /* end of the path section while returning, as a time after the present reference [s] */
    double sensors_odometry_age; /* maximum age of the odometry [s] */
    double sensors_pose_age;     /* maximum age of the pose; 0: no pose sensor, the pose of the odometry is used [s] */
    double sensors_gyro_age;     /* maximum age of the yaw rate; 0: no gyro, the wheels measure the yaw rate [s] */
    double sensors_ahead;        /* maximum time by which a stamp may be in the future [s] */
    double agreement_window;     /* time over which sensors are compared [s] */
    double agreement_blend;      /* time constant with which poses correct the pose predicted by wheels and gyro [s] */
    double agreement_distance;   /* maximum difference between poses and wheels within the window [m] */
    double agreement_distance_share; /* additional difference per distance driven [m/m] */
    double
        agreement_turn; /* maximum difference in heading of poses and gyro (no gyro: wheels) within the window [rad] */
    double agreement_gyro_gain;  /* maximum ratio of the yaw rate of the gyro to that of the wheels [-] */
    double agreement_gyro_least; /* minimum ratio of these yaw rates [-] */
    double agreement_gyro_turn;  /* tolerance of the turn over the window [rad] */
    double agreement_lasting;    /* maximum time for which sensors may contradict each other [s] */
    double answer_dead_time;     /* maximum delay until a command acts [s] */
    double answer_lag_v;         /* maximum time constant with which v follows [s] */
    double answer_lag_omega;     /* maximum time constant with which omega follows [s] */
    double answer_gain_v;        /* maximum ratio of v to its command [-] */
    double answer_gain_omega;    /* maximum ratio of omega to its command [-] */
    double answer_margin_v;      /* tolerance of the bounds of v [m/s] */
    double answer_margin_omega;  /* tolerance of the bounds of omega [rad/s] */
    double answer_lasting;       /* maximum time for which the robot may be outside the bounds [s] */
} ddmon_rules;

/* Rules; `ddmon_words` returns a sentence for each. */
enum {
    DDMON_NOTHING,
    DDMON_NOT_FINITE,
    DDMON_SPEED,
    DDMON_YAW_RATE,
    DDMON_SLEW,
    DDMON_YAW_SLEW,
    DDMON_SILENT,
    DDMON_SLOW,
    DDMON_FLOOD,
    DDMON_OLD_COMMAND,
    DDMON_COMMAND_AHEAD,
    DDMON_COMMAND_ORDER,
    DDMON_NOT_TO_MOVE,
    DDMON_CREEPS,
    DDMON_TURNS_AT_REST,
    DDMON_NO_REFERENCE,
    DDMON_BAD_REFERENCE,
    DDMON_STRAYS,
    DDMON_OFF_PATH,
    DDMON_OFF_HEADING,
    DDMON_ODOMETRY,
    DDMON_POSE,
    DDMON_GYRO,
    DDMON_POSE_JUMPS,
    DDMON_POSE_TURNS,
    DDMON_GYRO_WHEELS,
    DDMON_ANSWER_V,
    DDMON_ANSWER_OMEGA,
    DDMON_OUTSIDE,
    DDMON_CLOCK,
    DDMON_STILL_MOVED,
    DDMON_RULES
};

/* Pose of the reference at time `t`. */
typedef struct {
    double t, x, y, theta;
} ddmon_point;

/* Verdict: the violated rule, its time, and the measured value with its limit. DDMON_NOTHING: all rules hold. */
typedef struct {
    int rule;
    double at, value, limit;
} ddmon_verdict;

enum { DDMON_COMMANDS = 128, DDMON_TRACK = 256 };

/* State of one judge, in memory of the caller; only `ddmon_` functions access it. */
typedef struct {
    const ddmon_rules *rules;
    const ddmon_point *path;
    int points;
    double now, start;
    ddmon_verdict verdict;
    int broken[DDMON_RULES];
    double since[DDMON_RULES], value[DDMON_RULES], limit[DDMON_RULES];
    /* commands: last received, slew-limited, last sent, and a ring buffer of those that may still act */
    int commanded, has_command_stamp, sent;
    double command[2], command_at, command_stamp, followed[2], pace, output[2], output_at;
    double way_at[DDMON_COMMANDS], way_most[2][DDMON_COMMANDS], way_least[2][DDMON_COMMANDS];
    int way, ways;
    /* reported state of the controller: 1 drives, 0 stands, -1 no report */
    int may_move;
    double may_move_since;
    /* motion of the wheels since standstill after a drive, and time of the last sent command with motion */
    int rests;
    double crept[2], moved_at;
    /* last measurements of wheels, gyro and pose sensor, and bounds of the response */
    int has_odometry, has_pose, has_gyro;
    double odometry_stamp, wheels[2], gyro_stamp, gyro, pose_stamp, pose[3];
    double high[2][2], low[2][2], answered, slow_wheels, slow_gyro, free_at;
    /* integrated motion by wheels and gyro; pose of the robot and recent external motion; time away from the path */
    double track_at[DDMON_TRACK], track[3][DDMON_TRACK], summed[3];
    int track_last, tracks, placed, returning;
    double place[3], unexplained[3], driven, away_at, away_for, path_at;
} ddmon_judge;

/* Initialize the judge at `now`; `rules` must outlive it. */
DDMON_EXPORT void ddmon_init(ddmon_judge *judge, const ddmon_rules *rules, double now);

/* Set a new reference, which must live until the next one; points = 0 removes it. Returns 1 for a valid reference, with
   finite values, increasing times and speeds within the limits of commands. */
DDMON_EXPORT int ddmon_reference(ddmon_judge *judge, double now, const ddmon_point *path, int points);

/* Add odometry with `stamp`: twist of the wheels, and the integrated pose. */
DDMON_EXPORT void ddmon_odometry(ddmon_judge *judge, double now, double stamp, double v, double omega, double x,
                                 double y, double theta);

/* Add a yaw rate of the gyro. */
DDMON_EXPORT void ddmon_gyro(ddmon_judge *judge, double now, double stamp, double omega);

/* Add a pose in the frame of the reference. */
DDMON_EXPORT void ddmon_pose(ddmon_judge *judge, double now, double stamp, double x, double y, double theta);

/* Set the reported state of the controller: it drives (1) or stands (0). Send the reference again after a standstill. */
DDMON_EXPORT void ddmon_says(ddmon_judge *judge, double now, int drives);

/* Set (1) or clear (0) a fault that only the caller can detect; it stops the robot. */
DDMON_EXPORT void ddmon_outside(ddmon_judge *judge, double now, int wrong);

/* Check a command of the controller with `stamp`, 0 if it has none. Writes the command for the base into `out`. */
DDMON_EXPORT void ddmon_command(ddmon_judge *judge, double now, double stamp, double v, double omega, double out[2]);

/* Update the time; call about every 0.02 s. Returns 1 if the monitor has stopped the robot; then send `out`. */
DDMON_EXPORT int ddmon_tick(ddmon_judge *judge, double now, double out[2]);

/* Reset the judge on request of a person, if all rules hold, the robot stands and no command moves it. Otherwise returns
   the rule that is still violated. A robot further from its path than returning_distance loses its reference. */
DDMON_EXPORT ddmon_verdict ddmon_reset(ddmon_judge *judge, double now);

/* Return a sentence for a violated rule, and the unit of its value and limit. */
DDMON_EXPORT const char *ddmon_words(int rule);
DDMON_EXPORT const char *ddmon_unit(int rule);

#endif
