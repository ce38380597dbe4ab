// The firmware as avr-gcc built it, run by simavr, with the chips of a GY-85 on its I2C bus. Time is that of the
// simulated processor: nothing depends on how fast this machine is.
//
//     simulate FIRMWARE MCU SECONDS [MS:FAULT[:CHIP] ...]
//
// What it writes to its serial port goes to stdout. stderr has a line for each time (us) that the gyro's data were
// latched, and for each that a sample's first byte left: "gyro 1234", "byte 2345".
//
// Faults: nack (the next transfer to CHIP has no answer), gone, back, power (CHIP lost its supply for a moment), freeze
// (CHIP repeats its values), hold (the bus's hardware never finishes: somebody holds SDA), free, reset.
// MS:edges:RATE lets both encoders of a sketch with A at pins 2 and 3, B at 4 and 5 turn forward from then on, each with
// RATE edges of A a second, in hexadecimal, the right one 0.9 times as many. Last comes what they made: "edges 12 11".
// CHIP: 53 ADXL345, 68 ITG3205, 1e HMC5883L, with registers, reset values and order of bytes as in their data sheets.
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <simavr/avr_ioport.h>
#include <simavr/avr_twi.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>

#define CLOCK_HZ 16000000.0
#define MOST_FAULTS 32

typedef struct {
    uint8_t address, registers[256], at;
    int selected, at_is_next, answers, refuses, frozen;
    avr_irq_t *irq;
} chip;

typedef struct {
    uint64_t cycle;
    char what[16];
    int address;
} fault;

static avr_t *avr;
static chip chips[3] = {{.address = 0x53}, {.address = 0x68}, {.address = 0x1E}};
static fault faults[MOST_FAULTS];
static int fault_count, held, byte_is_first = 1;
static double edge_rate, turned[2];  // in edges of A
static long quarters[2];
static const char *irq_names[] = {"8>chip.out", "32<chip.in"};

static double seconds(void) { return avr->cycle / CLOCK_HZ; }

static void big(uint8_t *at, int value) { at[0] = (uint8_t)(value >> 8), at[1] = (uint8_t)value; }
static void little(uint8_t *at, int value) { at[1] = (uint8_t)(value >> 8), at[0] = (uint8_t)value; }

static void power_up(chip *c) {
    memset(c->registers, 0, sizeof c->registers);
    if (c->address == 0x53) c->registers[0x00] = 0xE5, c->registers[0x2C] = 0x0A;
    if (c->address == 0x68) c->registers[0x00] = 0x68;
    if (c->address == 0x1E) {
        c->registers[0] = 0x10, c->registers[1] = 0x20, c->registers[2] = 0x01;
        memcpy(c->registers + 10, "H43", 3);
    }
}

// What a chip measured by now: a turn of 20 degrees per second about z, gravity, a field, and noise of a count or two.
static void measure(chip *c) {
    static unsigned noise = 1;
    noise = noise * 1103515245u + 12345u;
    const int jitter = (int)((noise >> 16) % 5) - 2;
    uint8_t *r = c->registers;
    if (c->frozen) return;
    if (c->address == 0x53 && (r[0x2D] & 0x08)) {
        little(r + 0x32, jitter), little(r + 0x34, -jitter), little(r + 0x36, 256 + jitter);
    } else if (c->address == 0x68 && (r[0x16] & 0x18) == 0x18) {
        big(r + 0x1B, -13200 - 2800 + jitter);
        big(r + 0x1D, jitter), big(r + 0x1F, -jitter), big(r + 0x21, (int)lround(14.375 * 20.0) + jitter);
    } else if (c->address == 0x1E && (r[0x02] & 0x03) == 0) {
        const int turned = (int)lround(30.0 * sin(seconds()));
        big(r + 3, 200 + turned + jitter), big(r + 5, -400 + jitter), big(r + 7, 20 - turned);
    }
}

static void on_bus(avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    chip *c = param;
    avr_twi_msg_irq_t message;
    message.u.v = value;
    const uint32_t kind = message.u.twi.msg;
    avr_irq_t *back = c->irq + TWI_IRQ_INPUT;
    if (kind & (TWI_COND_STOP | TWI_COND_START)) c->selected = 0;
    if ((kind & TWI_COND_START) && message.u.twi.addr >> 1 == c->address && c->answers) {
        if (c->refuses) {
            c->refuses = 0;
            return;
        }
        c->selected = message.u.twi.addr;
        c->at_is_next = 1;
        if (message.u.twi.addr & 1) {
            measure(c);
            if (c->address == 0x68 && c->at == 0x15) fprintf(stderr, "gyro %.1f\n", seconds() * 1e6);
        }
        avr_raise_irq(back, avr_twi_irq_msg(TWI_COND_ACK, c->selected, 1));
    }
    if (!c->selected) return;
    if (kind & TWI_COND_WRITE) {
        avr_raise_irq(back, avr_twi_irq_msg(TWI_COND_ACK, c->selected, 1));
        const uint8_t data = message.u.twi.data;
        if (c->at_is_next) {
            c->at = data;
            c->at_is_next = 0;
        } else if (c->address == 0x68 && c->at == 0x3E && (data & 0x80)) {
            power_up(c);
        } else {
            c->registers[c->at++] = data;
        }
    }
    if (kind & TWI_COND_READ) {
        avr_raise_irq(back, avr_twi_irq_msg(TWI_COND_READ, c->selected, c->registers[c->at++]));
    }
}

static void on_byte(avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq, (void)param;
    if (byte_is_first) fprintf(stderr, "byte %.1f\n", seconds() * 1e6);
    byte_is_first = value == 0;  // frames end with a zero
    putchar((int)value);
}

static void attach(chip *c) {
    power_up(c);
    c->answers = 1;
    c->irq = avr_alloc_irq(&avr->irq_pool, 0, 2, irq_names);
    avr_irq_register_notify(c->irq + TWI_IRQ_OUTPUT, on_bus, c);
    avr_connect_irq(c->irq + TWI_IRQ_INPUT, avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_INPUT));
    avr_connect_irq(avr_io_getirq(avr, AVR_IOCTL_TWI_GETIRQ(0), TWI_IRQ_OUTPUT), c->irq + TWI_IRQ_OUTPUT);
}

// Going forward, A is a quarter ahead of B; an edge of A is two quarters from the next.
static void turn(double since_s) {
    for (int i = 0; i < 2; i++) {
        turned[i] += (i ? 0.9 : 1.0) * edge_rate * since_s;  // so that their edges meet
        const long now = (long)(2.0 * turned[i]);
        if (now == quarters[i]) continue;
        quarters[i] = now;
        avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), 2 + i), ((now + 1) & 3) >= 2);
        avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), 4 + i), (now & 3) >= 2);
    }
}

static void befall(const fault *f) {
    if (!strcmp(f->what, "hold")) held = 1;
    if (!strcmp(f->what, "free")) held = 0;
    if (!strcmp(f->what, "reset")) avr_reset(avr);
    if (!strcmp(f->what, "edges")) edge_rate = f->address;
    for (int i = 0; i < 3; i++) {
        chip *c = &chips[i];
        if (c->address != f->address) continue;
        if (!strcmp(f->what, "nack")) c->refuses = 1;
        if (!strcmp(f->what, "gone")) c->answers = 0;
        if (!strcmp(f->what, "back")) c->answers = 1;
        if (!strcmp(f->what, "power")) power_up(c);
        if (!strcmp(f->what, "freeze")) c->frozen = 1;
    }
}

// While SDA is held the hardware never reports the end of what it does: its flag stays clear, its interrupt away.
static void hold_bus(void) {
    const uint8_t vector = 24;  // TWI of an ATmega328P
    avr->data[0xBC] &= 0x7F;    // TWCR's TWINT
    for (int i = 0; i < avr->interrupts.vector_count; i++) {
        if (avr->interrupts.vector[i]->vector == vector) avr_clear_interrupt(avr, avr->interrupts.vector[i]);
    }
}

int main(int count, char **given) {
    elf_firmware_t firmware;
    memset(&firmware, 0, sizeof firmware);
    if (count < 4 || elf_read_firmware(given[1], &firmware)) return 2;
    strcpy(firmware.mmcu, given[2]);
    firmware.frequency = (uint32_t)CLOCK_HZ;
    const uint64_t end = (uint64_t)(atof(given[3]) * CLOCK_HZ);
    for (int i = 4; i < count && fault_count < MOST_FAULTS; i++) {
        fault *f = &faults[fault_count];
        double ms = 0.0;
        unsigned address = 0;
        if (sscanf(given[i], "%lf:%15[a-z]:%x", &ms, f->what, &address) < 2) return 2;
        f->cycle = (uint64_t)(ms * CLOCK_HZ / 1000.0), f->address = (int)address;
        fault_count++;
    }
    avr = avr_make_mcu_by_name(firmware.mmcu);
    if (!avr || avr_init(avr)) return 2;
    avr_load_firmware(avr, &firmware);
    for (int i = 0; i < 3; i++) attach(&chips[i]);
    uint32_t flags = 0;  // of the port: neither echoed here, nor slept in
    avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~(uint32_t)(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP);
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_byte, NULL);
    for (int next = 0; avr->cycle < end;) {
        while (next < fault_count && avr->cycle >= faults[next].cycle) befall(&faults[next++]);
        const avr_cycle_count_t before = avr->cycle;
        const int state = avr_run(avr);
        turn((double)(avr->cycle - before) / CLOCK_HZ);
        if (held) hold_bus();
        if (state == cpu_Done || state == cpu_Crashed) return 1;
    }
    fprintf(stderr, "edges %ld %ld\n", (quarters[0] + 1) / 2, (quarters[1] + 1) / 2);
    return 0;
}
