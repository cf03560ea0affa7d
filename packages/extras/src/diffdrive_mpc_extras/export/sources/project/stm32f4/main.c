/* Processor in the loop over USART1 (PA9, PA10; 115200 baud at the 16 MHz clock after reset).
 *
 * First sends the number of cycles of a million instructions, then replies to each request with the command and the
 * number of cycles of the step.
 */
#include "board.h"
#include "frames.h"
#include "trajectory.h"

static ddmpc_input input;

static double cycles_of_a_million_instructions(void)
{
    uint32_t count = 500000, start = SYSTICK_VALUE;
    __asm__ volatile("1: subs %0, %0, #1\n\tbne 1b" : "+r"(count) : : "cc");
    return elapsed_cycles(start);
}

int main(void)
{
    const ddmpc_reference reference = ddmpc_reference_of(&DDMPC_TRAJECTORY);
    ddmpc_controller *controller = ddmpc_open();
    initialise_board();
    double cycles = cycles_of_a_million_instructions();
    transmit(&cycles, sizeof cycles);
    for (;;) {
        double in[FRAME_IN], out[FRAME_OUT];
        receive(in, sizeof in);
        if (frame_read(in, &input)) {
            ddmpc_open();
            ddmpc_follow(controller, &reference, in[0]);
        }
        uint32_t start = SYSTICK_VALUE;
        frame_write(ddmpc_tick(controller, in[0], &input), out);
        out[8] = elapsed_cycles(start);
        transmit(out, sizeof out);
    }
}
