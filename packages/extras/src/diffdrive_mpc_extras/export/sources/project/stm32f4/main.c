/* Processor in the loop over USART1 (PA9, PA10; 115200 baud at the 16 MHz after reset).
 *
 * Begins by sending the cycles of a million instructions; then answers each frame with the command and the cycles of its
 * step.
 */
#include "board.h"
#include "frames.h"
#include "trajectory.h"

static ddmpc_input input;

static double cycles_of_a_million_instructions(void)
{
    uint32_t turns = 500000, since = SYSTICK_VALUE;
    __asm__ volatile("1: subs %0, %0, #1\n\tbne 1b" : "+r"(turns) : : "cc");
    return passed(since);
}

int main(void)
{
    const ddmpc_reference reference = ddmpc_reference_of(&DDMPC_TRAJECTORY);
    ddmpc_controller *controller = ddmpc_open();
    set_up();
    double cycles = cycles_of_a_million_instructions();
    transmit(&cycles, sizeof cycles);
    for (;;) {
        double in[FRAME_IN], out[FRAME_OUT];
        receive(in, sizeof in);
        if (frame_read(in, &input)) {
            ddmpc_open();
            ddmpc_follow(controller, &reference, in[0]);
        }
        uint32_t since = SYSTICK_VALUE;
        frame_write(ddmpc_tick(controller, in[0], &input), out);
        out[8] = passed(since);
        transmit(out, sizeof out);
    }
}
