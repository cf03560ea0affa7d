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

/* What has to hold; docs/monitor.md says of each what it is for. A rule that is broken for as long as it may be stops
   the robot. */
typedef struct {
    double commands_v;               /* largest |v| [m/s] */
    double commands_omega;           /* largest |omega| [rad/s] */
    double commands_v_slew;          /* fastest change of v away from zero [m/s^2] */
    double commands_omega_slew;      /* fastest change of omega away from zero [rad/s^2] */
    double commands_v_braking;       /* fastest change of v towards zero, and the monitor's own [m/s^2] */
    double commands_omega_braking;   /* fastest change of omega towards zero, and the monitor's own [rad/s^2] */
    double commands_jitter;          /* by so much time commands may come too early or too late for their slew [s] */
    double commands_silence;         /* longest time without a command after one that moves the robot [s] */
    double commands_slowest;         /* longest mean time between commands while the robot is moved [s] */
    double commands_quickest;        /* shortest mean time between commands [s] */
    double commands_oldest;          /* oldest stamp of a command that moves the robot [s] */
    double commands_stop_within;     /* after a controller says that it stands, its commands have to be zero [s] */
    double commands_standing_v;      /* a command or a motion smaller than this stands [m/s] */
    double commands_standing_omega;  /* a command or a motion smaller than this stands [rad/s] */
    double path_distance;            /* farthest from the stretch of path around the reference [m] */
    double path_lasting;             /* it may be further away for so long [s] */
    double path_far;                 /* farthest from there, if it braked now [m] */
    double path_reaction;            /* braking begins so late [s] */
    double path_heading;             /* farthest from the headings there [rad] */
    double path_far_lasting;         /* either may be too large for so long [s] */
    double path_late;                /* the stretch begins where the reference was so long ago [s] */
    double path_early;               /* and ends where it will be so much later [s] */
    double path_grace;               /* for so long a robot may be moved without a reference [s] */
    double returning_within;         /* a robot that something else moved has so long to be back on the stretch [s] */
    double returning_distance;       /* farthest from the stretch meanwhile, if it braked now [m] */
    double returning_late;           /* which begins so long ago meanwhile [s] */
    double returning_early;          /* and ends so much later [s] */
    double sensors_odometry_age;     /* oldest odometry [s] */
    double sensors_pose_age;         /* oldest pose; 0: there is no pose sensor, and odometry's pose counts [s] */
    double sensors_gyro_age;         /* oldest yaw rate; 0: there is no gyro, and nothing is compared with it [s] */
    double sensors_ahead;            /* stamps may be in the future by so much [s] */
    double agreement_window;         /* sensors are compared over so long [s] */
    double agreement_blend;          /* poses correct what wheels and gyro sum up over so long [s] */
    double agreement_distance;       /* poses against wheels: difference within the window [m] */
    double agreement_distance_share; /* and in addition by the distance [m/m] */
    double agreement_turn;           /* poses against gyro, else wheels: difference within the window [rad] */
    double agreement_gyro_gain;      /* gyro against wheels: most that the body turns for what the wheels do [-] */
    double agreement_gyro_least;     /* and least [-] */
    double agreement_gyro_turn;      /* and by so much more or less over the window [rad] */
    double agreement_lasting;        /* sensors may contradict each other for so long [s] */
    double answer_dead_time;         /* longest until a command acts [s] */
    double answer_lag_v;             /* slowest time constant with which v follows [s] */
    double answer_lag_omega;         /* slowest time constant with which omega follows [s] */
    double answer_gain_v;            /* most that the robot drives for what is commanded [-] */
    double answer_gain_omega;        /* most that the robot turns for what is commanded [-] */
    double answer_margin_v;          /* and by so much faster or slower [m/s] */
    double answer_margin_omega;      /* and by so much faster or slower [rad/s] */
    double answer_lasting;           /* the robot may be outside for so long [s] */
} ddmon_rules;

/* Which rule was broken; `ddmon_words` has a sentence for each. */
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

/* A verdict: the rule that was broken, what was found and what is allowed. DDMON_NOTHING: all is well. */
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
    /* commands: the last that came, the same within the slew, the last that was let through, those on their way */
    int commanded, stamped, sent;
    double command[2], command_at, command_stamp, followed[2], pace, output[2], output_at;
    double way_at[DDMON_COMMANDS], way_most[2][DDMON_COMMANDS], way_least[2][DDMON_COMMANDS];
    int way, ways;
    /* the controller's own word: 1 it drives, 0 it stands, -1 it has said nothing */
    int may_move;
    double may_move_since;
    /* sensors: by wheels, gyro and poses */
    int has_odometry, has_pose, has_gyro;
    double odometry_stamp, wheels[2], gyro_stamp, gyro, pose_stamp, pose[3];
    double high[2][2], low[2][2], answered, slow_wheels, slow_gyro, free_at;
    /* what wheels and gyro make of the motion; with poses: where the robot is, and what else moved it lately */
    double track_at[DDMON_TRACK], track[3][DDMON_TRACK], summed[3];
    int track_last, tracks, placed, returning;
    double place[3], unexplained[3], driven, moved_at, away_at;
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

/* The controller says whether it drives (1) or stands (0). */
DDMON_EXPORT void ddmon_says(ddmon_judge *judge, double now, int drives);

/* Something that only the caller can know is wrong (1), or is well again (0): it stops the robot. */
DDMON_EXPORT void ddmon_outside(ddmon_judge *judge, double now, int wrong);

/* A command of the controller with `stamp`, or 0 where it has none. Fills `out` with what the base is to get. */
DDMON_EXPORT void ddmon_command(ddmon_judge *judge, double now, double stamp, double v, double omega, double out[2]);

/* Time passes; call it every 0.02 s or so. Returns 1 where `out` is to be sent: the monitor has stopped the robot. */
DDMON_EXPORT int ddmon_tick(ddmon_judge *judge, double now, double out[2]);

/* A person wants to go on: all is forgotten but what is measured, if nothing is wrong any more, the robot stands and
   nobody moves it. Returns what is still wrong. A robot that is off its path loses its reference. */
DDMON_EXPORT ddmon_verdict ddmon_reset(ddmon_judge *judge, double now);

/* What is wrong where this rule is broken, in words, and the unit of value and limit. */
DDMON_EXPORT const char *ddmon_words(int rule);
DDMON_EXPORT const char *ddmon_unit(int rule);

#endif
