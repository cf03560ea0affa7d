/* Vector table and reset handler of a Cortex-M4F: enable the FPU, initialise memory, call main. */
#include <stdint.h>

extern uint32_t _stack_top, _data_start, _data_end, _data_source, _bss_start, _bss_end;
int main(void);
void reset_handler(void);

#define COPROCESSOR_ACCESS (*(volatile uint32_t *)0xE000ED88)

static void halt(void)
{
    for (;;) {
    }
}

void reset_handler(void)
{
    COPROCESSOR_ACCESS |= 0xFu << 20;
    __asm__ volatile("dsb\n\tisb");
    for (uint32_t *to = &_data_start, *from = &_data_source; to < &_data_end;)
        *to++ = *from++;
    for (uint32_t *to = &_bss_start; to < &_bss_end;)
        *to++ = 0;
    main();
    halt();
}

typedef void (*handler)(void);

/* Initial stack pointer, reset handler, system exceptions up to SysTick. */
__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    handler entry[15];
} vectors = {&_stack_top, {reset_handler, halt, halt, halt, halt, halt, 0, 0, 0, 0, halt, halt, 0, halt, halt}};
