/* USART1 (PA9, PA10; 115200 baud at the 16 MHz clock after reset) and SysTick of an STM32F4. */
#ifndef BOARD_H
#define BOARD_H

#include <stdint.h>

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define CLOCK_PORTS REGISTER(0x40023830)
#define CLOCK_USART REGISTER(0x40023844)
#define PORT_MODE REGISTER(0x40020000)
#define PORT_FUNCTION REGISTER(0x40020024)
#define USART_STATUS REGISTER(0x40011000)
#define USART_DATA REGISTER(0x40011004)
#define USART_RATE REGISTER(0x40011008)
#define USART_CONTROL REGISTER(0x4001100C)
#define SYSTICK_CONTROL REGISTER(0xE000E010)
#define SYSTICK_RELOAD REGISTER(0xE000E014)
#define SYSTICK_VALUE REGISTER(0xE000E018)
#define COUNTER_MASK 0xFFFFFFu

static inline void initialise_board(void)
{
    CLOCK_PORTS |= 1u;
    CLOCK_USART |= 1u << 4;
    PORT_MODE = (PORT_MODE & ~(0xFu << 18)) | (0xAu << 18);
    PORT_FUNCTION = (PORT_FUNCTION & ~(0xFFu << 4)) | (0x77u << 4);
    USART_RATE = 139;
    USART_CONTROL = (1u << 13) | (1u << 3) | (1u << 2);
    SYSTICK_RELOAD = COUNTER_MASK;
    SYSTICK_VALUE = 0;
    SYSTICK_CONTROL = 5;
}

static inline void receive(void *bytes, unsigned count)
{
    for (uint8_t *byte = bytes; count--; byte++) {
        while (!(USART_STATUS & (1u << 5))) {
        }
        *byte = (uint8_t)USART_DATA;
    }
}

static inline void transmit(const void *bytes, unsigned count)
{
    for (const uint8_t *byte = bytes; count--; byte++) {
        while (!(USART_STATUS & (1u << 7))) {
        }
        USART_DATA = *byte;
    }
}

/* Return the cycles since the counter value `start`; SysTick counts downwards. */
static inline double elapsed_cycles(uint32_t start) { return (double)((start - SYSTICK_VALUE) & COUNTER_MASK); }

#endif
