/* The judge of the monitor: looks at what a controller sends and at what the robot does, and says whether to let it
 * pass. Plain C99; nothing is allocated, printed or read, and no code of the controller is needed or known.
 *
 * Times are seconds on one clock, which never goes back; lengths m, angles rad, counter-clockwise. Call from one thread.
 */
#ifndef DDMON_JUDGE_H
#define DDMON_JUDGE_H

#ifndef DDMON_EXPORT
#define DDMON_EXPORT
#endif

/* Limits of the rules; docs/safety.md says what each rule is for. A rule that is broken for longer than its limit allows
   stops the robot. */
typedef struct {
    double commands_v;               /* largest |v| [m/s] */
    double commands_omega;           /* largest |omega| [rad/s] */
    double commands_v_reverse;       /* largest speed in reverse [m/s]; 0: as v */
    double commands_omega_right;     /* largest yaw rate to the right [rad/s]; 0: as omega */
    double commands_v_slew;          /* largest rate of change of v away from zero [m/s^2] */
    double commands_omega_slew;      /* largest rate of change of omega away from zero [rad/s^2] */
    double commands_v_braking;       /* largest rate of change of v towards zero; the monitor itself brakes at it [m/s^2] */
    double commands_omega_braking;   /* largest rate of change of omega towards zero; the monitor itself brakes at it [rad/s^2] */
    double commands_jitter;          /* tolerated error in the timing of commands, for the check of their slew [s] */
    double commands_silence;         /* longest time without a command while the last one moves the robot [s] */
    double commands_slowest;         /* longest mean interval between commands while the robot is moved [s] */
    double commands_quickest;        /* shortest mean interval between commands [s] */
    double commands_oldest;          /* largest age of a command that moves the robot, by its stamp [s] */
    double commands_stop_within;     /* time for commands to become zero after the controller says that it stands [s] */
    double commands_standing_v;      /* a command or a motion up to this speed counts as standing [m/s] */
    double commands_standing_omega;  /* a command or a motion up to this yaw rate counts as standing [rad/s] */
    double commands_rest_distance;   /* largest distance that the robot moves after the controller says that it stands [m] */
    double commands_rest_turn;       /* largest angle by which it turns meanwhile [rad] */
    double path_distance;            /* largest distance from the stretch of path around the reference [m] */
    double path_lasting;             /* longest time for which the distance may be larger [s] */
    double path_far;                 /* largest distance of the place where the robot would stand if it braked now [m] */
    double path_reaction;            /* delay until braking begins [s] */
    double path_heading;             /* largest angle to the headings of the stretch [rad] */
    double path_far_lasting;         /* longest time for which `far` or `heading` may be exceeded [s] */
    double path_late;                /* the stretch begins where the reference was so long ago [s] */
    double path_early;               /* the stretch ends where the reference will be so much later [s] */
    double path_grace;               /* longest motion without a reference, or while the controller says that it stands [s] */
    double returning_within;         /* longest time away from the stretch while the robot returns [s] */
    double returning_distance;       /* largest distance, meanwhile, of the place where it would stand if it braked now [m] */
    double returning_late;           /* meanwhile, the stretch begins where the reference was so long ago [s] */
    double returning_early;          /* meanwhile, the stretch ends where the reference will be so much later [s] */
    double sensors_odometry_age;     /* largest age of the odometry [s] */
    double sensors_pose_age;         /* largest age of the pose; 0: there is no pose sensor, and the pose of the odometry is used [s] */
    double sensors_gyro_age;         /* largest age of the yaw rate; 0: there is no gyro, and the wheels measure the yaw rate [s] */
    double sensors_ahead;            /* largest time by which a stamp may lie in the future [s] */
    double agreement_window;         /* time over which sensors are compared [s] */
    double agreement_blend;          /* time constant with which poses correct the place that wheels and gyro carry on [s] */
    double agreement_distance;       /* largest difference between poses and wheels within the window [m] */
    double agreement_distance_share; /* additional difference per distance driven [m/m] */
    double agreement_turn;           /* largest difference in heading of poses and gyro (no gyro: wheels) within the window [rad] */
    double agreement_gyro_gain;      /* largest ratio of the yaw rate of the gyro to that of the wheels [-] */
    double agreement_gyro_least;     /* smallest ratio of the two [-] */
    double agreement_gyro_turn;      /* tolerated turn beyond these ratios over the window [rad] */
    double agreement_lasting;        /* longest time for which sensors may contradict each other [s] */
    double answer_dead_time;         /* longest delay until a command acts [s] */
    double answer_lag_v;             /* largest time constant with which v follows [s] */
    double answer_lag_omega;         /* largest time constant with which omega follows [s] */
    double answer_gain_v;            /* largest ratio of v to its command [-] */
    double answer_gain_omega;        /* largest ratio of omega to its command [-] */
    double answer_margin_v;          /* tolerated speed beyond these bounds [m/s] */
    double answer_margin_omega;      /* tolerated yaw rate beyond these bounds [rad/s] */
    double answer_lasting;           /* longest time for which the robot may be outside the bounds [s] */
} ddmon_rules;

/* Rules; `ddmon_words` has a sentence for each. */
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

/* A pose of the reference and when it is due. */
typedef struct {
    double t, x, y, theta;
} ddmon_point;

/* A verdict: the rule that was broken, the value measured and its limit. DDMON_NOTHING: all rules hold. */
typedef struct {
    int rule;
    double at, value, limit;
} ddmon_verdict;

enum { DDMON_COMMANDS = 128, DDMON_TRACK = 256 };

/* State of one judge, in memory of the caller; for `ddmon_` functions alone. */
typedef struct {
    const ddmon_rules *rules;
    const ddmon_point *path;
    int points;
    double now, began;
    ddmon_verdict verdict;
    int broken[DDMON_RULES];
    double since[DDMON_RULES], value[DDMON_RULES], limit[DDMON_RULES];
    /* commands: the last one received, the same within the slew, the last one passed on, and those that may still act */
    int commanded, stamped, sent;
    double command[2], command_at, command_stamp, followed[2], pace, output[2], output_at;
    double way_at[DDMON_COMMANDS], way_most[2][DDMON_COMMANDS], way_least[2][DDMON_COMMANDS];
    int way, ways;
    /* reported state of the controller: 1 drives, 0 stands, -1 no report */
    int may_move;
    double may_move_since;
    /* since it stands after a drive: motion of the wheels; and when the last command that moves the robot was passed on */
    int rests;
    double crept[2], moved_at;
    /* sensors: by wheels, gyro and poses */
    int has_odometry, has_pose, has_gyro;
    double odometry_stamp, wheels[2], gyro_stamp, gyro, pose_stamp, pose[3];
    double high[2][2], low[2][2], answered, slow_wheels, slow_gyro, free_at;
    /* motion by wheels and gyro; with poses: where the robot is, and what else moved it lately; until when and for how
       long it was away from its path */
    double track_at[DDMON_TRACK], track[3][DDMON_TRACK], summed[3];
    int track_last, tracks, placed, returning;
    double place[3], unexplained[3], driven, away_at, away_for, path_at;
} ddmon_judge;

/* Begin at `now`; `rules` have to live as long as the judge. */
DDMON_EXPORT void ddmon_init(ddmon_judge *judge, const ddmon_rules *rules, double now);

/* A new reference, which has to live until the next; none with points = 0. Returns 1 where it can be followed: its
   numbers are finite, its times rise, and it is nowhere faster than commands may be. */
DDMON_EXPORT int ddmon_reference(ddmon_judge *judge, double now, const ddmon_point *path, int points);

/* Odometry with `stamp`: twist of the wheels, and the pose that it sums up. */
DDMON_EXPORT void ddmon_odometry(ddmon_judge *judge, double now, double stamp, double v, double omega,
                                 double x, double y, double theta);

/* Yaw rate of the gyro. */
DDMON_EXPORT void ddmon_gyro(ddmon_judge *judge, double now, double stamp, double omega);

/* A pose in the frame of the reference. */
DDMON_EXPORT void ddmon_pose(ddmon_judge *judge, double now, double stamp, double x, double y, double theta);

/* The controller says whether it drives (1) or stands (0). After it stood its reference is late: send that anew. */
DDMON_EXPORT void ddmon_says(ddmon_judge *judge, double now, int drives);

/* A fault that only the caller can detect is present (1) and stops the robot, or is over (0). */
DDMON_EXPORT void ddmon_outside(ddmon_judge *judge, double now, int wrong);

/* A command of the controller with `stamp`, or 0 where it has none. Fills `out` with what the base is to get. */
DDMON_EXPORT void ddmon_command(ddmon_judge *judge, double now, double stamp, double v, double omega, double out[2]);

/* Time passes; call it every 0.02 s or so. Returns 1 where `out` is to be sent: the monitor has stopped the robot. */
DDMON_EXPORT int ddmon_tick(ddmon_judge *judge, double now, double out[2]);

/* A person lets the robot drive again: if no rule is broken any more, the robot stands and no command moves it, the judge
   begins anew with its measurements. Returns the rule that is still broken. A robot further from its path than a robot
   that returns may be (returning_distance) loses its reference. */
DDMON_EXPORT ddmon_verdict ddmon_reset(ddmon_judge *judge, double now);

/* A sentence for a broken rule, and the unit of its value and limit. */
DDMON_EXPORT const char *ddmon_words(int rule);
DDMON_EXPORT const char *ddmon_unit(int rule);

#endif
